"""Where the voxels of an image file lie, checked: spacing, axes and origin that a body may have.

Every reader hands its header's numbers over in millimetres, whatever unit they are written in.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError
from us_sim.settings.spelling import shown

MILLIMETRES = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "nm": 1e-6}
MILLIMETRES |= {"meter": 1e3, "centimeter": 10.0, "millimeter": 1.0, "micron": 1e-3, "inch": 25.4}
"""By the names of units in image files."""

_METRES = 1e-3  # image files hold millimetres
_SPACINGS = (1e-4, 1e2)  # mm, from a microscope's to one voxel for half a limb
_FARTHEST = 1e5  # mm
_ORTHONORMAL = 1e-3  # what rounding may do to the products of a direction matrix's columns


def millimetres(path: Path | str, unit: str) -> float:
    """How many millimetres a unit has that a header names; an empty name means millimetres.

    Raises:
        VolumeError: it is no unit of length.
    """
    name = unit.strip().lower()
    for known in (name, name.removesuffix("s").replace("metre", "meter")):
        if known in MILLIMETRES:
            return MILLIMETRES[known]
    if name in ("", "?"):
        return 1.0
    raise VolumeError(
        f"{path}: states its lengths in {shown(unit[:80])}, which is no known unit: write mm"
    )


def checked_placement(
    path: Path | str,
    spacing: ArrayLike | None,
    direction: ArrayLike,
    origin: ArrayLike,
    given: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """(4, 4) from voxel indices to m.

    Args:
        path: which errors name.
        spacing: (3,) mm, between voxels along each axis of the grid; None where it is not stated.
        direction: (3, 3), whose columns are those axes.
        origin: (3,) mm, of the first voxel's centre.
        given: (3,) mm, the spacing where the file does not state it, as a person says it.

    Raises:
        VolumeError: a number is not finite, the spacing is neither stated nor given, or both, the
            axes span no volume or are not at right angles, or the size or place is none that a
            body has.
    """
    if spacing is not None and given is not None:
        raise VolumeError(f"{path}: states the spacing of its voxels: leave out --spacing")
    if spacing is None and given is None:
        raise VolumeError(
            f"{path}: does not state how far its voxels are apart: find out, and say it with "
            f"`us-sim import --spacing X,Y,Z` (mm)"
        )
    spacing = given if spacing is None else spacing
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
