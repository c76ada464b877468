"""The names of the files of a bag that is to be written.

>>> from pathlib import Path
>>> from us_sim.recording.bag_names import BagNames
>>> names = BagNames(Path("/there/is/no/session"), sidecar=True, further=False)
>>> [str(name) for name in (names.first, names.further(), names.metadata)]
['/there/is/no/session/session_0.mcap', '/there/is/no/session/session_1.mcap', \
'/there/is/no/session/metadata.yaml']
"""

from __future__ import annotations

from itertools import count
from pathlib import Path

from us_sim.errors import BagError
from us_sim.share import full_path


class BagNames:
    """Names of files that are not there yet.

    Args:
        path: ``FILE.mcap``, or a new folder, as `us_sim.recording.writer.BagWriter` says.
        sidecar: whether there is to be a ``metadata.yaml``.
        further: where ``FILE.mcap`` exists, the first file is ``FILE_1.mcap`` or the next that is
            free, without ``metadata.yaml``.

    Raises:
        BagError: something is there already.
        OSError, ValueError: no file can have such a name.
    """

    def __init__(self, path: Path, *, sidecar: bool, further: bool) -> None:
        is_folder = path.suffix != ".mcap"
        self._stem = full_path(path).name if is_folder else path.stem
        self.first = path / f"{self._stem}_0.mcap" if is_folder else path
        self.metadata: Path | None = None
        if further and self.first.exists():
            self.first = self.further()
            return
        if self.first.exists():
            raise BagError(f"{self.first} exists already: choose another name or remove it")
        if is_folder and path.is_dir() and any(path.iterdir()):
            raise BagError(f"{path} exists already and is not empty: choose another name")
        if not sidecar:
            return
        self.metadata = self.first.with_name("metadata.yaml")
        if self.metadata.exists():
            own = self.first.with_suffix("") / self.first.name
            raise BagError(
                f"{self.metadata} belongs to another recording: record into a folder of its own, "
                f"such as {own}"
            )

    def further(self) -> Path:
        """The next file that is not there."""
        return next(
            file
            for number in count(1)
            if not (file := self.first.with_name(f"{self._stem}_{number}.mcap")).exists()
        )
