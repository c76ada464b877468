"""A recording of rerun that is being written: a file that is there when it is whole.

>>> import tempfile
>>> from pathlib import Path
>>> from us_sim.to_rerun.rerun_file import RerunFile, require_rerun
>>> require_rerun()  # doctest: +SKIP
>>> file = Path(tempfile.mkdtemp()) / "session.rrd"
>>> with RerunFile(file, "session") as recording:  # doctest: +SKIP
...     recording.at(stamp=1_700_000_000_000_000_000, recorded=1_700_000_000_004_000_000)
...     recording.log("probe/force", rerun.Scalars([0.0, 0.0, -2.5]))
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from us_sim.errors import BagError

OLDEST = "0.41"
"""Of the versions of rerun, the oldest with which this works."""
STAMP = "stamp"
"""Timeline of the poses that messages come from."""
RECORDED = "recorded"
"""Timeline of when messages came to the recorder."""


def require_rerun() -> None:
    """Refuse at once where rerun is not installed, or too old.

    Raises:
        BagError: it is.
    """
    try:
        import rerun
    except ImportError:
        raise BagError(f"rerun is not installed: pip install 'rerun-sdk>={OLDEST}'") from None
    if tuple(map(int, rerun.__version__.split(".")[:2])) < tuple(map(int, OLDEST.split("."))):
        raise BagError(f"rerun {rerun.__version__} is too old: pip install 'rerun-sdk>={OLDEST}'")


class RerunFile:
    """Logs to a file beside the one that is wanted, which it becomes when all is written.

    Args:
        file: to write, which must not be there.
        name: of the recording, as the viewer lists it.

    Raises:
        BagError: the file is there already, or its folder cannot be written to.
    """

    def __init__(self, file: Path, name: str) -> None:
        import rerun

        self._file = file
        self._partial = file.with_name(f"{file.name}.part")
        if file.exists():
            raise BagError(f"{file} exists already: choose another file with --out")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._partial.touch()
        except OSError as error:
            raise BagError(f"{file} cannot be written: {error.strerror}") from None
        self._stream = rerun.RecordingStream("us_sim")
        self._stream.set_log_time_enabled(False)  # when it was converted is of no interest
        self._stream.save(self._partial)
        self._stream.send_recording_name(name)
        self._frames: dict[str, str] = {}

    def at(self, stamp: int | None, recorded: int) -> None:
        """Say when what is logged from now on was.

        Args:
            stamp: ns since 1970, of the measurement; None of what has no stamp.
            recorded: ns since 1970.
        """
        moments = {STAMP: recorded if stamp is None else stamp, RECORDED: recorded}
        for timeline, moment in moments.items():
            self._stream.set_time(timeline, timestamp=np.datetime64(moment, "ns"))

    def log(self, entity: str, *parts: Any, static: bool = False) -> None:
        """Log archetypes of rerun, at the time that was said, or as what does not change."""
        self._stream.log(entity, *parts, static=static)

    def place(self, entity: str, frame: str) -> None:
        """Say in which frame an entity is, at all times: the last that was said."""
        import rerun

        if self._frames.get(entity) != frame:
            self._frames[entity] = frame
            self.log(entity, rerun.CoordinateFrame(frame), static=True)

    def show(self, blueprint: Any) -> None:
        """Say what the viewer opens."""
        self._stream.send_blueprint(blueprint)

    def __enter__(self) -> RerunFile:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stream.flush()
        self._stream.disconnect()
        if error is not None:
            self._partial.unlink(missing_ok=True)
        else:
            self._partial.rename(self._file)
