"""The probe that made a sweep and where it was, as far as the sweep's images tell."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from us_sim.errors import UsSimError
from us_sim.geometry.pose import Placement
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.choice import Chosen
from us_sim.settings.registry import PROBES
from us_sim.volume.reconstruction.scanned_part import (
    Fan,
    Rectangle,
    box_around,
    fitted_part,
    seen_pixels,
)
from us_sim.volume.reconstruction.settings import ImagePart
from us_sim.volume.sequences.sweep import Sweep

_POSES = 33
_SKEWED = 0.05  # cosine between columns and rows, more than a calibration is inexact
_UNLIKE = 0.1  # of the two sides of pixels, beyond which an arc in pixels is none in metres
_BORDER = 2.0  # pixels of a fan, which `image_mask` leaves out
_POINT = 5e-3  # m: beams from a smaller arc are a phased array's, which all leave one place
_PHASED = 0.02  # m, the aperture of usual phased arrays, which their images do not show
_WIDEST = 0.08  # m, of a linear array: a wider rectangle is something else


@dataclass(frozen=True)
class ScanningProbe:
    """What scanned, and where."""

    probe: ProbeSettings | None  # None where nothing says which it was
    poses: tuple[Placement, ...]  # in the sweep's reference frame, evenly along its path


def scanning_probe(sweep: Sweep, part: ImagePart, used: NDArray[np.bool_]) -> ScanningProbe:
    """The probe of a sweep, and where its face was.

    It is the fan that the part names, or what the images prove, or a linear array as wide as the
    rectangle that the part names. Where there is none of these, the middle of what is not black at
    the images' top is taken for the middle of its face.

    Args:
        sweep: with poses.
        part: of the images.
        used: (rows, columns) the pixels of that part.

    Raises:
        VolumeError: the images are damaged.
    """
    matrices = sweep.image_to_reference
    steps = np.linalg.norm(matrices[:, :3, :2], axis=1)
    across, down = np.moveaxis(matrices[:, :3, :2] / steps[:, None, :], -1, 0)
    pixel = np.median(steps, axis=0)
    seen = seen_pixels(sweep)
    shape: Fan | Rectangle | None = None
    if np.abs((across * down).sum(axis=1)).max() <= _SKEWED:
        shape = _given(part, used, pixel) or fitted_part(seen, pixel, used)
    if shape is not None:
        return ScanningProbe(_probe(shape), _poses(matrices, shape, pixel))
    box = box_around(
        used if part.clip is not None or not (seen & used).any() else seen & used, pixel
    )
    return ScanningProbe(
        _probe(box) if part.clip is not None else None, _poses(matrices, box, pixel)
    )


def _given(part: ImagePart, used: NDArray[np.bool_], pixel: NDArray[np.float64]) -> Fan | None:
    """The fan that a person or a calibration names."""
    if part.fan_origin is None or part.fan_radius is None or part.fan_angles is None:
        return None
    if abs(pixel[0] / pixel[1] - 1.0) > _UNLIKE:
        return None
    rows, columns = np.nonzero(used)
    farthest = np.hypot(columns - part.fan_origin[0], rows - part.fan_origin[1]).max()
    begins, ends = part.fan_radius
    if ends > farthest + _BORDER:
        ends = float(farthest)
    x, z = (float(place) for place in np.array(part.fan_origin) * pixel)
    side = float(pixel.mean())
    return Fan((x, z), (begins * side, ends * side), part.fan_angles)


def _probe(shape: Fan | Rectangle) -> ProbeSettings | None:
    """None where there is no such probe."""
    if isinstance(shape, Rectangle):
        kind, depth = "linear", shape.z[1] - shape.z[0]
        values = {"aperture": round(shape.x[1] - shape.x[0], 5)}
        if values["aperture"] > _WIDEST:
            return None
    elif shape.radius[0] < _POINT:
        kind, depth = "sector", shape.radius[1]
        values = {"aperture": _PHASED, "opening_angle": round(shape.opening_angle, 5)}
    else:
        kind, depth = "convex", shape.radius[1] - shape.radius[0]
        values = {"radius": round(shape.radius[0], 5)}
        values["opening_angle"] = round(shape.opening_angle, 5)
    made: Any = PROBES.settings(kind)
    try:
        array = Chosen(kind, made(**values, depth=round(depth, 5)))
    except UsSimError:  # out of the range of probes
        return None
    return ProbeSettings(array=array, image=512)


def _poses(
    matrices: NDArray[np.float64], shape: Fan | Rectangle, pixel: NDArray[np.float64]
) -> tuple[Placement, ...]:
    """Of the middle of the probe's face at some frames, as far apart along the sweep as can be."""
    face, ahead, depth = _beam(shape)
    middle = np.array([*((face + 0.5 * depth * ahead) / pixel), 0.0, 1.0])
    seen = (matrices @ middle)[:, :3]
    moved = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(seen, axis=0), axis=1))])
    evenly = np.linspace(0.0, moved[-1], _POSES)
    picked = np.unique(np.abs(moved[:, None] - evenly).argmin(axis=0))
    return tuple(_pose(matrices[k], face / pixel, ahead) for k in picked)


def _beam(shape: Fan | Rectangle) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """The middle beam in the image: its start (2,) m, its direction (2,), its length."""
    if isinstance(shape, Rectangle):
        start = np.array([0.5 * (shape.x[0] + shape.x[1]), shape.z[0]])
        return start, np.array([0.0, 1.0]), shape.z[1] - shape.z[0]
    angle = 0.5 * (shape.angles[0] + shape.angles[1])
    ahead = np.array([math.sin(angle), math.cos(angle)])
    begins = shape.radius[0] if shape.radius[0] >= _POINT else 0.0
    return shape.apex + begins * ahead, ahead, shape.radius[1] - begins


def _pose(
    matrix: NDArray[np.float64], face: NDArray[np.float64], ahead: NDArray[np.float64]
) -> Placement:
    """Of the probe, from the place of its image (4, 4) and its middle beam in pixels."""
    position = (matrix @ [*face, 0.0, 1.0])[:3]
    across, down = (matrix[:3, :2] / np.linalg.norm(matrix[:3, :2], axis=0)).T
    z = ahead[0] * across + ahead[1] * down
    z /= np.linalg.norm(z)
    x = across - (across @ z) * z
    x /= np.linalg.norm(x)
    orientation = Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z])).as_quat()
    a, b, c = (round(float(value), 5) for value in position)
    i, j, k, w = (round(float(value), 6) for value in orientation)
    return Placement((a, b, c), (i, j, k, w))
