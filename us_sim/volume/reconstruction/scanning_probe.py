"""The probe that made a sweep and where it was, as the sweep's images show them.

The scanned part of the images is the fan or the rectangle that is not black. A shape that does not
fit its edges well is none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_fill_holes, binary_opening
from scipy.ndimage import label as connected_parts
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import theilslopes

from us_sim.errors import UsSimError
from us_sim.geometry.pose import Placement
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.choice import Chosen
from us_sim.settings.registry import PROBES
from us_sim.volume.reconstruction.settings import ImagePart
from us_sim.volume.sequences.sweep import Sweep

_COUNTED = 80.0  # percent of an edge's points that may not be farther off than is allowed
_LEAST_POINTS = 16  # of an edge
_NARROW = math.radians(4.0)  # opening angle below which it is no fan
_POINT = 5e-3  # m: beams from a smaller arc are a phased array's, which all leave one place


@dataclass(frozen=True)
class Fan:
    """Beams from an arc; m from the centre of pixel (0, 0), x along rows, z along columns."""

    apex: tuple[float, float]
    radius: tuple[float, float]  # where beams begin and end
    angles: tuple[float, float]  # of the first and last beam, from +z towards +x

    @property
    def opening_angle(self) -> float:
        """Between the outermost beams."""
        return self.angles[1] - self.angles[0]

    def holds(self, x: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points are in it."""
        across, down = x - self.apex[0], z - self.apex[1]
        radius, angle = np.hypot(across, down), np.arctan2(across, down)
        held = (radius >= self.radius[0]) & (radius <= self.radius[1])
        return np.asarray(held & (angle >= self.angles[0]) & (angle <= self.angles[1]))


@dataclass(frozen=True)
class Rectangle:
    """Parallel beams; m from the centre of pixel (0, 0), x along rows, z along columns."""

    x: tuple[float, float]
    z: tuple[float, float]

    def holds(self, x: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points are in it."""
        held = (x >= self.x[0]) & (x <= self.x[1]) & (z >= self.z[0]) & (z <= self.z[1])
        return np.asarray(held)


@dataclass(frozen=True)
class ScanningProbe:
    """The probe of a sweep, and its places."""

    probe: ProbeSettings | None  # None where nothing says which it was
    poses: tuple[Placement, ...]  # in the sweep's reference frame, evenly along its path


def scanning_probe(sweep: Sweep, part: ImagePart, used: NDArray[np.bool_]) -> ScanningProbe:
    """The probe of a sweep, and where its face was.

    It is the fan that the part names, or the shape that fits the images, or a linear array as wide
    as the rectangle that the part names. Where there is none of these, the middle of the pixels
    that are not black at the images' top is taken for the middle of its face.

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
    if np.abs((across * down).sum(axis=1)).max() <= 0.05:  # more than a calibration is inexact
        shape = _named_fan(part, used, pixel) or fitted_part(seen, pixel, used)
    if shape is not None:
        return ScanningProbe(_probe(shape), _poses(matrices, shape, pixel))
    has_clip = part.clip is not None
    box = _box_around(used if has_clip or not (seen & used).any() else seen & used, pixel)
    return ScanningProbe(_probe(box) if has_clip else None, _poses(matrices, box, pixel))


def seen_pixels(sweep: Sweep) -> NDArray[np.bool_]:
    """(rows, columns) whether a pixel is not black in most of 32 frames all over a sweep.

    Raises:
        VolumeError: the images are damaged.
    """
    count = len(sweep.numbers)
    picked = np.unique(np.linspace(0, count - 1, min(count, 32)).round().astype(int))
    often = np.zeros((sweep.rows, sweep.columns), dtype=np.int32)
    for image in sweep.images(picked.tolist()):
        often += image > 0
    # Lossy compression spills grey levels beyond the border, other ones in every frame.
    return np.asarray(often >= 0.7 * len(picked))


def fitted_part(
    seen: NDArray[np.bool_], pixel: NDArray[np.float64], used: NDArray[np.bool_] | None = None
) -> Fan | Rectangle | None:
    """The fan or the rectangle that was scanned; None where neither fits.

    Args:
        seen: (rows, columns) pixels that are not black.
        pixel: (2,) m, from one column to the next, and from one row to the next.
        used: pixels that count; edges on their border are not the probe's where they cut a fan.
    """
    within = np.ones_like(seen) if used is None else used
    body = _body(seen & within)
    if body is None:
        return None
    edges = _Edges(body, within, pixel)
    rows, columns = np.indices(body.shape)
    x, z = columns * pixel[0], rows * pixel[1]
    best: Fan | Rectangle | None = None
    least = 0.95  # intersection over union of the seen pixels with the shape
    for part in (_rectangle(edges), _fan(edges)):
        if part is None:
            continue
        inside = part.holds(x, z) & within
        overlap = float((inside & body).sum() / max(1, (inside | body).sum()))
        if overlap > least:
            best, least = part, overlap
    return best


def _named_fan(part: ImagePart, used: NDArray[np.bool_], pixel: NDArray[np.float64]) -> Fan | None:
    if part.fan_origin is None or part.fan_radius is None or part.fan_angles is None:
        return None
    if abs(pixel[0] / pixel[1] - 1.0) > 0.1:  # an arc in pixels is none in metres
        return None
    rows, columns = np.nonzero(used)
    farthest = np.hypot(columns - part.fan_origin[0], rows - part.fan_origin[1]).max()
    begins, ends = part.fan_radius
    if ends > farthest + 2.0:  # pixels; `image_mask` leaves out the border
        ends = float(farthest)
    x, z = (float(place) for place in np.array(part.fan_origin) * pixel)
    side = float(pixel.mean())
    return Fan((x, z), (begins * side, ends * side), part.fan_angles)


def _box_around(seen: NDArray[np.bool_], pixel: NDArray[np.float64]) -> Rectangle:
    """The smallest rectangle of pixels around the largest part of those seen (rows, columns)."""
    body = _body(seen)
    rows, columns = np.nonzero(seen if body is None else body)
    x, z = (
        (float((each.min() - 0.5) * side), float((each.max() + 0.5) * side))
        for each, side in ((columns, pixel[0]), (rows, pixel[1]))
    )
    return Rectangle(x, z)


def _body(seen: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """The largest connected part, without its holes; letters and scales beside it are others."""
    around, small = np.pad(seen, 1), np.ones((3, 3))
    smooth = binary_opening(binary_fill_holes(binary_closing(around, small)), small)
    parts, count = connected_parts(smooth[1:-1, 1:-1])
    if not count:
        return None
    return np.asarray(parts == int(np.argmax(np.bincount(parts.reshape(-1))[1:])) + 1)


class _Edges:
    """Points (N, 2) m, x and z, on the left, right, upper and lower border of a part.

    Of the ``free`` ones those that the image cuts are left out.
    """

    def __init__(
        self, body: NDArray[np.bool_], within: NDArray[np.bool_], pixel: NDArray[np.float64]
    ) -> None:
        around = np.pad(within, 1)
        rows = np.flatnonzero(body.any(axis=1))
        columns = np.flatnonzero(body.any(axis=0))
        first = body[rows].argmax(axis=1)
        last = body.shape[1] - 1 - body[rows, ::-1].argmax(axis=1)
        top = body[:, columns].argmax(axis=0)
        bottom = body.shape[0] - 1 - body[::-1, columns].argmax(axis=0)
        self.pixel = pixel
        self.height = len(rows) * float(pixel[1])
        places = (
            (first - 0.5, rows), (last + 0.5, rows), (columns, top - 0.5), (columns, bottom + 0.5)
        )  # fmt: skip
        self.all = [np.column_stack(place) * pixel for place in places]
        left = around[rows + 1, first] & (np.arange(len(rows)) <= np.argmin(first))
        right = around[rows + 1, last + 2] & (np.arange(len(rows)) <= np.argmax(last))
        free = (left, right, around[top, columns + 1], around[bottom + 2, columns + 1])
        self.free = [points[kept] for points, kept in zip(self.all, free, strict=True)]

    def allowed(self, depth: float) -> float:
        """m, by which most points of an edge may be off."""
        return 0.01 * depth + 1.5 * float(self.pixel.max())


def _rectangle(edges: _Edges) -> Rectangle | None:
    places = [float(np.median(edges.all[k][:, k // 2])) for k in range(4)]
    left, right, top, bottom = places
    off = [np.percentile(np.abs(edges.all[k][:, k // 2] - places[k]), _COUNTED) for k in range(4)]
    if max(off) > edges.allowed(bottom - top):
        return None
    return Rectangle((left, right), (top, bottom))


def _fan(edges: _Edges) -> Fan | None:
    """By its four edges together, with little weight on points that are far off."""
    lines = _lines(edges)
    if lines is None:
        return None
    left, right, over, under = _on_fan(edges.free, *lines)
    apex, _, _ = lines
    if len(over) < _LEAST_POINTS:
        if len(_on_fan(edges.all, *lines)[2]) >= _LEAST_POINTS:
            return None  # the image cuts off the face
        over = edges.all[2][edges.all[2][:, 1].argmin()][None, :]  # the beams' common start
    if len(under) < _LEAST_POINTS:
        under = edges.all[3][edges.all[3][:, 1].argmax()][None, :]  # it cuts off the bottom
    if min(len(left), len(right)) < _LEAST_POINTS:
        return None
    begins, ends = (float(np.median(np.hypot(*(each - apex).T))) for each in (over, under))

    def off(shape: NDArray[np.float64] | list[float]) -> list[NDArray[np.float64]]:
        x, z, first, last, begins, ends = shape
        return [
            (left - [x, z]) @ [math.cos(first), -math.sin(first)],
            (right - [x, z]) @ [math.cos(last), -math.sin(last)],
            np.hypot(*(over - [x, z]).T) - begins,
            np.hypot(*(under - [x, z]).T) - ends,
        ]

    fitted = least_squares(
        lambda shape: np.concatenate(off(shape)),
        [*apex, *lines[1:], begins, ends],
        loss="soft_l1",
        f_scale=float(edges.pixel.max()),
        x_scale=[1e-3, 1e-3, 1e-2, 1e-2, 1e-3, 1e-3],
    )
    x, z, first, last, begins, ends = map(float, fitted.x)
    if not (0.0 <= begins < ends and last - first > _NARROW):
        return None
    worst = [np.percentile(np.abs(each), _COUNTED) for each in off(fitted.x) if len(each)]
    if max(worst) > edges.allowed(ends - begins):
        return None
    return Fan((x, z), (begins, ends), (first, last))


def _on_fan(
    edges: list[NDArray[np.float64]], apex: NDArray[np.float64], first: float, last: float
) -> list[NDArray[np.float64]]:
    """Of the points of four edges, those that lie where a fan's edges do."""
    angles = [np.arctan2(*(points - apex).T) for points in edges]
    # Beside a corner a fan's top is its side rather than its face.
    middle, corner = 0.5 * (first + last), 0.1 * (last - first)
    left, right, over, under = edges
    across = (angles[2] > first + corner) & (angles[2] < last - corner)
    below = (angles[3] > first) & (angles[3] < last)
    return [left[angles[0] < middle], right[angles[1] > middle], over[across], under[below]]


def _lines(edges: _Edges) -> tuple[NDArray[np.float64], float, float] | None:
    """A fan's apex (2,) m and the angles of its sides, at first."""
    fits = []
    for side in edges.free[:2]:
        if len(side) < _LEAST_POINTS or np.ptp(side[:, 1]) < 0.25 * edges.height:
            return None
        some = side[:: 1 + len(side) // 200]
        fits.append(theilslopes(some[:, 0], some[:, 1])[:2])
    (slope, base), (other, further) = fits
    if math.atan(other) - math.atan(slope) < _NARROW:
        return None
    z = (base - further) / (other - slope)
    return np.array([slope * z + base, z]), math.atan(slope), math.atan(other)


def _probe(shape: Fan | Rectangle) -> ProbeSettings | None:
    if isinstance(shape, Rectangle):
        kind, depth = "linear", shape.z[1] - shape.z[0]
        values = {"aperture": round(shape.x[1] - shape.x[0], 5)}
        if values["aperture"] > 0.08:  # m: a wider rectangle is something else
            return None
    elif shape.radius[0] < _POINT:
        kind, depth = "sector", shape.radius[1]
        # Images do not show the aperture, m; this is that of usual phased arrays.
        values = {"aperture": 0.02, "opening_angle": round(shape.opening_angle, 5)}
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
    if isinstance(shape, Rectangle):
        face, ahead = np.array([0.5 * (shape.x[0] + shape.x[1]), shape.z[0]]), np.array([0.0, 1.0])
        depth = shape.z[1] - shape.z[0]
    else:
        angle = 0.5 * (shape.angles[0] + shape.angles[1])
        ahead = np.array([math.sin(angle), math.cos(angle)])
        begins = shape.radius[0] if shape.radius[0] >= _POINT else 0.0
        face, depth = shape.apex + begins * ahead, shape.radius[1] - begins
    middle = np.array([*((face + 0.5 * depth * ahead) / pixel), 0.0, 1.0])
    seen = (matrices @ middle)[:, :3]
    moved = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(seen, axis=0), axis=1))])
    evenly = np.linspace(0.0, moved[-1], 33)
    picked = np.unique(np.abs(moved[:, None] - evenly).argmin(axis=0))
    return tuple(_pose(matrices[k], face / pixel, ahead) for k in picked)


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
