"""Mesh files of unknown origin, read by meshio within bounded memory and with checked indices."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from us_sim.errors import MeshError

_MEMORY = 1 << 30  # Bytes that reading a file may take, and `_MEMORY_PER_BYTE` times its size
_MEMORY_PER_BYTE = 64


def read_with_meshio(path: Path, refusal: str) -> Any:
    """The mesh that meshio makes of a file.

    Args:
        path: of the file.
        refusal: the error of a file that cannot be read.

    Raises:
        MeshError: it cannot be read, or not within bounded memory, a second file that goes with it
            is missing, or meshio or a package that it needs is missing.
    """
    try:
        import meshio
    except ImportError as error:
        raise MeshError(
            f"reading a {path.suffix or 'mesh'} file needs meshio; install it with "
            f"`pip install meshio`"
        ) from error
    if path.suffix.lower() == ".ply" and not _has_ply_header(path):
        raise MeshError(refusal)
    try:
        # For a file that none of its readers takes, meshio prints and then leaves the process.
        silence = io.StringIO()
        with (
            contextlib.redirect_stdout(silence),
            contextlib.redirect_stderr(silence),
            np.errstate(all="ignore"),
            _bounded_memory(_MEMORY + _MEMORY_PER_BYTE * path.stat().st_size),
        ):
            mesh = meshio.read(path)
            count = len(mesh.points)
            for block in mesh.cells:
                # An index below 0 would count from the last point.
                if len(block.data) and not 0 <= np.min(block.data) <= np.max(block.data) < count:
                    raise MeshError(
                        f"the file has cells that name points beyond the {count} that are there"
                    )
            return mesh
    except MeshError:
        raise
    except FileNotFoundError as error:
        # Formats of two files: TetGen's `.node` and `.ele`, XDMF with HDF5.
        other = Path(error.filename or "").name or "another file"
        raise MeshError(
            f"it goes with {other}, which is not beside it: copy both into one folder"
        ) from error
    except ModuleNotFoundError as error:
        raise MeshError(
            f"reading it needs {error.name}; install it with `pip install {error.name}`"
        ) from error
    except (Exception, SystemExit) as error:
        raise MeshError(refusal) from error


def _has_ply_header(path: Path) -> bool:
    """Whether the header of a PLY file ends; meshio would look for its end for ever."""
    with path.open("rb") as file:
        return any(line.strip() == b"end_header" for line in file)


@contextlib.contextmanager
def _bounded_memory(more: int) -> Iterator[None]:
    """Limit this process to so many bytes more, where the system can."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        before = resource.getrlimit(resource.RLIMIT_AS)
    except (ImportError, OSError, ValueError):
        yield
        return
    bound = pages * resource.getpagesize() + more
    if before[0] != resource.RLIM_INFINITY:
        bound = min(bound, before[0])
    resource.setrlimit(resource.RLIMIT_AS, (bound, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
