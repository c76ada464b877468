"""Files that are there whole at the end, or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from us_sim.errors import UsSimError, VolumeError


@contextmanager
def partial_file(
    path: Path, name: str = "partial", error_type: type[UsSimError] = VolumeError
) -> Iterator[Path]:
    """Give the path of a file to write, beside another, whose place it takes at the end.

    Args:
        path: of the file at the end; one that is there is replaced.
        name: of the file until then, for writers that look at its ending.
        error_type: of the error.

    Raises:
        UsSimError: of that type, it cannot be written.
    """
    folder = ""
    try:
        folder = tempfile.mkdtemp(prefix=f".{path.name}.partial-", dir=path.parent)
        yield Path(folder, name)
        os.replace(Path(folder, name), path)
    except OSError as error:
        raise error_type(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        if folder:
            Path(folder, name).unlink(missing_ok=True)
            os.rmdir(folder)
