"""A folder that is there whole at the end, or not at all.

>>> import tempfile
>>> from pathlib import Path
>>> with tempfile.TemporaryDirectory() as root:
...     with new_folder(Path(root, "made")) as folder:
...         _ = (folder / "labels.txt").write_text("1 vein")
...     [file.name for file in Path(root, "made").iterdir()]
['labels.txt']
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from us_sim.errors import VolumeError


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder to write to, which gets its name at the end.

    Raises:
        VolumeError: there is something of that name, or it cannot be made.
    """
    if os.path.lexists(folder):
        raise VolumeError(f"{folder}: exists already; choose another name, or remove it")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.partial-", dir=folder.parent))
    except OSError as error:
        raise VolumeError(f"{folder}: cannot be made: {error.strerror}") from error
    try:
        mask = os.umask(0)
        os.umask(mask)
        partial.chmod(0o777 & ~mask)  # as any folder; mkdtemp's are the owner's alone
        yield partial
        try:
            os.rename(partial, folder)
        except OSError as error:
            raise VolumeError(f"{folder}: cannot be made: {error.strerror}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
