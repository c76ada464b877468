"""Bags of wrenches."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.recording.schemas import load_jazzy_definitions, serialize_stamped
from us_sim.recording.topic import DEFAULT_QOS
from us_sim.recording.writer import BagWriter

WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"


class WrenchRecord(NamedTuple):
    """Wrenches of one sensor."""

    topic: str
    frame_id: str
    stamps: NDArray[np.int64]  # (K,) ns
    wrenches: NDArray[np.float64]  # (K, 6) N and N m


def write_wrenches(file: str | Path | BagWriter, record: WrenchRecord) -> None:
    """Writes them as a bag of their one topic, or beside other topics into one that is open.

    Raises:
        BagError: the file exists or cannot be written.
    """
    if not isinstance(file, BagWriter):
        with BagWriter(file, compression="zstd") as writer:
            write_wrenches(writer, record)
        return
    file.add_topic(record.topic, WRENCH_STAMPED, [DEFAULT_QOS])
    types = load_jazzy_definitions().types
    vector = types["geometry_msgs/msg/Vector3"]
    for stamp, wrench in zip(record.stamps.tolist(), record.wrenches.tolist(), strict=True):
        force, torque = vector(*wrench[:3]), vector(*wrench[3:])
        measured = types["geometry_msgs/msg/Wrench"](force=force, torque=torque)
        message = serialize_stamped(WRENCH_STAMPED, stamp, record.frame_id, wrench=measured)
        file.write_message(record.topic, message, stamp, stamp)
