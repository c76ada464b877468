"""The wrenches of a bag: forces and torques over time, from a simulated probe or from a sensor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import BagError
from us_sim.recording.reader import read_bag

WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"


@dataclass(frozen=True, eq=False)
class WrenchRecord:
    """Wrenches in the order in which they were recorded."""

    topic: str
    frame_id: str
    stamps: NDArray[np.int64]  # (K,) ns since the epoch, of the messages' headers
    wrenches: NDArray[np.float64]  # (K, 6) force N and torque N m, frame frame_id; as recorded

    def __len__(self) -> int:
        return len(self.stamps)


def read_wrenches(path: str | Path, topic: str = "probe/wrench") -> WrenchRecord:
    """Reads the wrenches on a topic of a bag.

    Args:
        path: any bag that ``read_bag`` reads.
        topic: its name, with or without the leading slash.

    Raises:
        BagError: there is no such bag or topic, it is of another type, is silent, or its wrenches
            are of several frames.
    """
    bag = read_bag(path)
    chosen = bag.topic(topic)
    if chosen.type_name != WRENCH_STAMPED:
        raise BagError(
            f"{bag.path} holds {chosen.name} as {chosen.type_name}, not {WRENCH_STAMPED}"
        )
    stamps: list[int] = []
    wrenches: list[tuple[float, ...]] = []
    frames: dict[str, None] = {}
    for raw in bag.messages([chosen.name]):
        message = bag.deserialize(raw)
        stamp, f, t = message.header.stamp, message.wrench.force, message.wrench.torque
        stamps.append(stamp.sec * 10**9 + stamp.nanosec)
        wrenches.append((f.x, f.y, f.z, t.x, t.y, t.z))
        frames[message.header.frame_id] = None
    if not stamps:
        raise BagError(f"{bag.path} holds no wrench on {chosen.name}; {bag.note or 'it is silent'}")
    if len(frames) > 1:
        raise BagError(
            f"{bag.path} holds wrenches on {chosen.name} in the frames {', '.join(frames)}: one "
            f"sensor has one frame"
        )
    times = np.array(stamps, dtype=np.int64)
    return WrenchRecord(chosen.name, next(iter(frames)), times, np.array(wrenches))
