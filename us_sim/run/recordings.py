"""The files that the recorders of a run have written."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from us_sim.run.graph import NodeProcess
from us_sim.run.losses import files_of


class Recordings:
    """Finds the files of each recorder that was started, without those that were there before."""

    def __init__(self) -> None:
        self._older: dict[Path, set[Path]] = {}  # by the file that was asked for
        self._begun: dict[Path, float] = {}  # likewise, s, monotonic

    def begin(self, recorder: NodeProcess) -> None:
        """A recorder is about to be started for the first time."""
        file = Path(str(recorder.all_parameters["file"]))
        self._older.setdefault(file, set(files_of(file)))
        self._begun.setdefault(file, time.monotonic())

    def progress(self, file: Path) -> dict[str, str]:
        """What diagnostics say of a recording: its age, its size, and the room that is left."""
        if file not in self._begun:
            return {}
        try:
            sizes = [
                each.stat().st_size for each in files_of(file) if each not in self._older[file]
            ]
            room = shutil.disk_usage(file.parent).free
        except OSError:  # the folder was taken away; the recorder says so
            return {}
        return {
            "record_seconds": f"{time.monotonic() - self._begun[file]:.0f}",
            "record_bytes": str(sum(sizes)),
            "record_room_bytes": str(room),
        }

    def files(self) -> list[Path]:
        """What is there by now, in the order in which it was begun."""
        return [
            found
            for file, older in self._older.items()
            for found in files_of(file)
            if found not in older
        ]
