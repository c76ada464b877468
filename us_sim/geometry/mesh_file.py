"""Mesh files of others, read by meshio, with checked indices."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any

import numpy as np

from us_sim.errors import MeshError


def read_with_meshio(path: Path, refusal: str) -> Any:
    """Read a mesh by meshio; ``refusal`` is the error of a file that cannot be read.

    Raises:
        MeshError: it cannot be read, a second file that goes with it is missing, or meshio or a
            package that it needs is.
    """
    try:
        import meshio
    except ImportError as error:
        raise MeshError(
            f"reading a {path.suffix or 'mesh'} file needs meshio; install it with "
            f"`pip install meshio`"
        ) from error
    try:
        # For a file that none of its readers takes, meshio prints and then leaves the process.
        silence = io.StringIO()
        with contextlib.redirect_stdout(silence), contextlib.redirect_stderr(silence):
            mesh = meshio.read(path)
        count = len(mesh.points)
        for block in mesh.cells:
            # An index below 0 would count from the last point.
            if len(block.data) and not 0 <= np.min(block.data) <= np.max(block.data) < count:
                raise MeshError(f"the file has cells that name points beyond its {count}")
        return mesh
    except MeshError:
        raise
    except (FileNotFoundError, ModuleNotFoundError) as error:
        # Of formats of two files: TetGen's `.node` and `.ele`, XDMF with HDF5.
        missing = Path(getattr(error, "filename", "") or getattr(error, "name", "") or "").name
        raise MeshError(
            f"it needs {missing or 'another file'}, which is not there: copy it beside the file, "
            f"or install the package of that name"
        ) from error
    except (Exception, SystemExit) as error:
        raise MeshError(refusal) from error
