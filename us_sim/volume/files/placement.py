"""The place of an image file's voxels, checked: spacing, axes and origin that a body may have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError

MILLIMETRES = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "nm": 1e-6}
MILLIMETRES |= {"meter": 1e3, "centimeter": 10.0, "millimeter": 1.0, "micron": 1e-3, "inch": 25.4}
"""By the names of units in image files."""

_SPACINGS = (1e-4, 1e2)  # mm, from a microscope's to one voxel for half a limb
_FARTHEST = 1e5  # mm
_RIGHT_ANGLE = 1e-3  # cosine between axes, of files read and written; rounding makes 2e-4


def to_millimetres(path: Path | str, unit: str) -> float:
    """Return the millimetres of a unit that a header names; an empty name means millimetres."""
    name = unit.strip().lower()
    for known in (name, name.removesuffix("s").replace("metre", "meter")):
        if known in MILLIMETRES:
            return MILLIMETRES[known]
    if name in ("", "?", "???", "none"):
        return 1.0
    raise VolumeError(f"{path}: states its lengths in {unit!r}, which is no known unit: write mm")


def is_right_angled(direction: NDArray[np.float64]) -> bool:
    """Tell whether axes of length 1, the columns (3, 3), are at right angles but for rounding."""
    return bool(np.abs(direction.T @ direction - np.eye(3)).max() <= _RIGHT_ANGLE)


def measure_skew(direction: NDArray[np.float64]) -> float:
    """Return by how many degrees the farthest two axes are off a right angle."""
    cosines = np.abs(np.triu(direction.T @ direction, 1)).max()
    return float(np.degrees(np.arcsin(min(cosines, 1.0))))


def make_placement(
    path: Path | str,
    spacing: ArrayLike | None,
    direction: ArrayLike,
    origin: ArrayLike,
    given: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Place voxels: (4, 4) from their indices to m.

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
    spacing = np.asarray(given if spacing is None else spacing, np.float64)
    origin = np.asarray(origin, np.float64)
    direction = np.asarray(direction, np.float64).reshape(3, 3)
    lengths = np.linalg.norm(direction, axis=0)
    along = direction / np.where(lengths > 0.0, lengths, 1.0)
    if not (_SPACINGS[0] <= spacing.min() and spacing.max() <= _SPACINGS[1]):  # nan is not
        problem = f"the voxel spacing {' × '.join(f'{side:g}' for side in spacing)} mm"
    elif not np.abs(origin).max() <= _FARTHEST:
        problem = f"an origin that is {np.abs(origin).max() / 1e3:.3g} m away"
    elif not abs(np.linalg.det(along)) > 1e-6:
        problem = "a direction matrix that is singular or not finite"
    elif not is_right_angled(along):
        problem = f"axes that are {measure_skew(along):.2g}° off a right angle (sheared)"
    elif np.abs(lengths - 1.0).max() > _RIGHT_ANGLE:
        problem = "axes that are scaled by its direction matrix"
    else:
        placement = np.eye(4)
        placement[:3, :3] = direction * spacing * 1e-3
        placement[:3, 3] = origin * 1e-3
        return placement
    raise VolumeError(f"{path}: has {problem}: correct its header, or resample it")
