"""The files that the recorders of a run have written."""

from __future__ import annotations

from pathlib import Path

from us_sim.run.graph import NodeProcess
from us_sim.run.losses import files_of

__all__ = ["Recordings"]


class Recordings:
    """Finds the files of each recorder that was started, without those that were there before."""

    def __init__(self) -> None:
        self._older: dict[Path, set[Path]] = {}  # by the file that was asked for

    def begin(self, recorder: NodeProcess) -> None:
        """A recorder is about to be started for the first time."""
        file = Path(str(recorder.all_parameters["file"]))
        self._older.setdefault(file, set(files_of(file)))

    def files(self) -> list[Path]:
        """What is there by now, in the order in which it was begun."""
        return [
            found
            for file, older in self._older.items()
            for found in files_of(file)
            if found not in older
        ]
