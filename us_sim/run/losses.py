"""Losses of a run: nodes that ended or hung, and images that are not in the recordings."""

from __future__ import annotations

import contextlib
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from us_sim.errors import BagError
from us_sim.run.plan import NodeProcess

IMAGES, IMAGER = "ultrasound/image", "slice_interpolator"
TOLD = 4  # losses that are told one by one in a sentence


@dataclass
class Loss:
    """A node that ended or hung, and its restart."""

    node: str
    what: str  # it did: "was ended by SIGKILL"
    at_s: float  # since the nodes were started
    last_words: str = ""  # of the node
    back_after_s: float | None = None  # until it reported again
    given_up: str = ""  # why it was not started again
    time: str = field(default_factory=lambda: datetime.now().astimezone().isoformat())

    def __str__(self) -> str:
        """For a person."""
        then = f" and {self.given_up}" if self.given_up else ""
        if self.back_after_s is not None:
            then = f" and was back after {self.back_after_s:.1f} s"
        return f"{self.node} {self.what} at {self.at_s:.1f} s{then}"


@dataclass(frozen=True)
class Outcome:
    """How a run went."""

    startup: float  # s until all nodes were ready
    losses: Sequence[Loss]
    files: Sequence[Path]  # recorded, in their order
    made: int  # images, that the node which makes them has reported
    recorded: int  # of them
    poses: int | None  # that there were to play, or images of a video
    awaited: str = ""  # why nothing was played

    def sentence(self) -> str:
        """Return the losses, for a person; nothing when there are none."""
        lacks_images = bool(self.files) and self.recorded < self.made
        if not (self.losses or self.awaited or lacks_images):
            return ""
        told = [str(loss) for loss in self.losses[:TOLD]]
        if len(self.losses) > TOLD:
            told.append(f"and {len(self.losses) - TOLD} more times nodes ended or hung")
        if self.awaited:
            told.append(f"nothing was played: it waited for {self.awaited}")
        if lacks_images:
            told.append(f"{self.recorded} images were recorded of {self.made} that were made")
        elif self.files and self.losses:
            of = f" of {self.poses} poses" if self.poses is not None else ""
            told.append(f"{self.recorded} images were recorded{of}")
        if self.files:
            told.append(f"the recording is in {', '.join(file.name for file in self.files)}")
        return "; ".join(told)

    def summary(self) -> dict[str, Any]:
        """As one JSON-like mapping."""
        return {
            "nodes": [asdict(loss) for loss in self.losses],
            "images_made": self.made,
            "images_recorded": self.recorded,
            "files": [file.name for file in self.files],
        }


def files_of(recording: Path) -> list[Path]:
    """A recording's file and those in which it goes on: ``session.mcap``, ``session_1.mcap``, …"""
    pattern = re.compile(rf"{re.escape(recording.stem)}((?:_\d+)*){re.escape(recording.suffix)}")
    found = {file: pattern.fullmatch(file.name) for file in recording.parent.glob("*")}
    numbers = {file: [*map(int, match[1].split("_")[1:])] for file, match in found.items() if match}
    return sorted(numbers, key=numbers.__getitem__)


def images_in(files: Sequence[Path], name: str = f"/{IMAGES}") -> int:
    """The images in recordings, by their topic's name; a file that cannot be read has none."""
    from us_sim.recording.reader import read_bag  # takes long to import, and starts need it not

    count = 0
    for file in files:
        with contextlib.suppress(BagError):
            topics = read_bag(file).topics
            count += sum(topic.message_count for topic in topics if topic.name == name)
    return count


class Recordings:
    """Finds the files of each recorder that was started, without those that were there before."""

    def __init__(self) -> None:
        # By the file asked for: those that were there, and when it was begun (s, monotonic).
        self._begun: dict[Path, tuple[set[Path], float]] = {}

    def begin(self, recorder: NodeProcess) -> None:
        """Note that a recorder is about to be started."""
        file = Path(str(recorder.parameters["file"]))
        self._begun.setdefault(file, (set(files_of(file)), time.monotonic()))

    def progress(self, file: Path) -> dict[str, str]:
        """Return age and size of a recording and the room that is left, as in diagnostics."""
        if file not in self._begun:
            return {}
        try:
            size = sum(each.stat().st_size for each in self._files(file))
            room = shutil.disk_usage(file.parent).free
        except OSError:  # the folder was taken away; the recorder says so
            return {}
        seconds = time.monotonic() - self._begun[file][1]
        return {
            "record_seconds": f"{seconds:.0f}",
            "record_bytes": str(size),
            "record_room_bytes": str(room),
        }

    def files(self) -> list[Path]:
        """Return the files that are there by now, in the order in which they were begun."""
        return [found for file in self._begun for found in self._files(file)]

    def _files(self, file: Path) -> list[Path]:
        return [found for found in files_of(file) if found not in self._begun[file][0]]
