"""Where the voxels of an image file lie, checked: spacing, axes and origin that a body may have.

>>> import numpy as np
>>> from us_sim.volume.files.placement import checked_placement
>>> placement = checked_placement("a.nrrd", (0.5, 0.5, 1.0), np.eye(3), (10.0, 0.0, -20.0))
>>> placement @ [2, 0, 5, 1]
array([ 0.011,  0.   , -0.015,  1.   ])
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError

__all__ = ["checked_placement"]

_METRES = 1e-3  # image files hold millimetres
_SPACINGS = (1e-4, 1e2)  # mm, from a microscope's to one voxel for half a limb
_FARTHEST = 1e5  # mm
_ORTHONORMAL = 1e-3  # what rounding may do to the products of a direction matrix's columns


def checked_placement(
    path: Path | str, spacing: ArrayLike, direction: ArrayLike, origin: ArrayLike
) -> NDArray[np.float64]:
    """(4, 4) from voxel indices to m.

    Args:
        path: which errors name.
        spacing: (3,) mm, between voxels along each axis of the grid.
        direction: (3, 3), whose columns are those axes.
        origin: (3,) mm, of the first voxel's centre.

    Raises:
        VolumeError: a number is not finite, the axes span no volume or are not at right angles, or
            the size or place is none that a body has.
    """
    spacing, origin = np.asarray(spacing, np.float64), np.asarray(origin, np.float64)
    direction = np.asarray(direction, np.float64).reshape(3, 3)
    # MetaImage turns a spacing that is not a number into 0 before it comes here.
    if not (np.isfinite(spacing).all() and (spacing > 0.0).all()):
        raise VolumeError(
            f"{path}: has the voxel spacing {' × '.join(f'{s:g}' for s in spacing)} mm; every "
            f"spacing must be a number above zero"
        )
    if not (np.isfinite(direction).all() and np.isfinite(origin).all()):
        raise VolumeError(f"{path}: has an origin or a direction matrix that is not finite")
    if abs(np.linalg.det(direction)) < 1e-6:
        raise VolumeError(f"{path}: has a singular direction matrix, so its axes span no volume")
    if np.abs(direction.T @ direction - np.eye(3)).max() > _ORTHONORMAL:
        raise VolumeError(
            f"{path}: has axes that are sheared or scaled by its direction matrix; resample it on "
            f"a grid with right angles"
        )
    if not (_SPACINGS[0] <= spacing.min() and spacing.max() <= _SPACINGS[1]):
        raise VolumeError(
            f"{path}: has the voxel spacing {' × '.join(f'{s:g}' for s in spacing)} mm; that of a "
            f"body is {_SPACINGS[0]:g} to {_SPACINGS[1]:g} mm: correct it"
        )
    if np.abs(origin).max() > _FARTHEST:
        raise VolumeError(
            f"{path}: lies {np.abs(origin).max() / 1e3:.3g} m from its origin; {_FARTHEST / 1e3:g} "
            f"m are possible at most: correct it"
        )
    placement = np.eye(4)
    placement[:3, :3] = direction * spacing * _METRES
    placement[:3, 3] = origin * _METRES
    return placement
