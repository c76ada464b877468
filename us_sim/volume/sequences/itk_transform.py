"""Transforms in files of ITK (`.tfm`, `.txt`, `.h5`), as 3D Slicer writes them; read by SimpleITK.

Slicer writes the way from the parent to the child, in LPS and millimetres. Returned is the matrix
that Slicer itself shows: to the parent, in RAS.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.sequences.transforms import in_metres

TRANSFORM_SUFFIXES = (".h5", ".hdf5", ".tfm", ".txt")
_TO_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def read_slicer_transform(path: str | Path) -> NDArray[np.float64]:
    """Read the transform (4, 4) of a file, m, to the parent in RAS; named by its file."""
    import SimpleITK as sitk  # which takes a tenth of a second

    path = Path(path)
    if not path.is_file():
        raise VolumeError(f"{path}: there is no such file")
    try:
        transform = sitk.ReadTransform(str(path))
    except (RuntimeError, ValueError) as error:
        raise VolumeError(
            f"{path}: is damaged, or no transform of ITK; export a linear one from 3D Slicer"
        ) from error
    if transform.GetDimension() != 3 or not transform.IsLinear():
        raise VolumeError(
            f"{path}: holds {transform.GetName()}, which is not linear in 3D; export a linear "
            f"transform from 3D Slicer"
        )
    to_child = np.eye(4)
    to_child[:3, 3] = origin = np.array(transform.TransformPoint((0.0, 0.0, 0.0)))
    for axis, point in enumerate(np.eye(3)):
        to_child[:3, axis] = np.array(transform.TransformPoint(point)) - origin
    try:
        return in_metres(path.stem, _TO_LPS @ np.linalg.inv(to_child) @ _TO_LPS)
    except np.linalg.LinAlgError:
        raise VolumeError(f"{path}: its transform has no inverse; export it again") from None
