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
from scipy.ndimage import binary_closing, binary_erosion, binary_fill_holes, binary_opening
from scipy.ndimage import label as connected_parts
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import theilslopes

from us_sim.errors import UsSimError
from us_sim.geometry.pose import Placement, Pose
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.choice import ChosenOption
from us_sim.settings.registry import PROBES
from us_sim.volume.cases.proposal import round_pose
from us_sim.volume.reconstruction.settings import ImagePart
from us_sim.volume.sequences.sweep import TrackedSweep

_LEAST_POINTS = 16  # of an edge
_NARROW = math.radians(4.0)  # opening angle below which it is no fan
_ALIKE = 0.95  # intersection over union of the seen pixels with a shape that fits
_POINT = 5e-3  # m: beams from a smaller arc are a phased array's, which all leave one place


@dataclass(frozen=True)
class Fan:
    """Beams from an arc; m from the centre of pixel (0, 0), x along rows, z along columns."""

    apex: tuple[float, float]
    radius: tuple[float, float]  # where beams begin and end
    angles: tuple[float, float]  # of the first and last beam, from +z towards +x

    def contains(self, x: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell whether points are in it."""
        across, down = x - self.apex[0], z - self.apex[1]
        radius, angle = np.hypot(across, down), np.arctan2(across, down)
        held = (radius >= self.radius[0]) & (radius <= self.radius[1])
        return np.asarray(held & (angle >= self.angles[0]) & (angle <= self.angles[1]))


@dataclass(frozen=True)
class Rectangle:
    """Parallel beams; m from the centre of pixel (0, 0), x along rows, z along columns."""

    x: tuple[float, float]
    z: tuple[float, float]

    def contains(self, x: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Tell whether points are in it."""
        held = (x >= self.x[0]) & (x <= self.x[1]) & (z >= self.z[0]) & (z <= self.z[1])
        return np.asarray(held)


@dataclass(frozen=True)
class ScanningProbe:
    """The probe of a sweep, and its places."""

    probe: ProbeSettings | None  # None where nothing says which it was
    poses: tuple[Placement, ...]  # in the sweep's reference frame, evenly along its path


def find_scanning_probe(
    sweep: TrackedSweep, part: ImagePart, used: NDArray[np.bool_]
) -> ScanningProbe:
    """Find the probe of a sweep, and where its face was.

    It is the fan that the part names, or the shape that fits the images, or a linear array as wide
    as the rectangle that the part names. Where there is none of these, the middle of the images'
    top is taken for the middle of its face. The pixels of the part are those ``used`` (rows,
    columns).

    Raises:
        VolumeError: the images are damaged.
    """
    pixel = np.median(np.linalg.norm(sweep.image_to_reference[:, :3, :2], axis=1), axis=0)
    shape: Fan | Rectangle | None = _named_fan(part, used, pixel)
    if shape is None:
        picked = _spread(sweep, 32)
        often = np.sum([image > 0 for image in sweep.read_images(picked.tolist())], axis=0)
        # Lossy compression spills grey levels beyond the border, other ones in every frame.
        shape = fit_part(often >= 0.7 * len(picked), pixel, used)
    is_known = shape is not None or part.clip is not None
    shape = shape or _rectangle(used, pixel)
    return ScanningProbe(_probe(shape) if is_known else None, _poses(sweep, shape, pixel))


def fit_part(
    seen: NDArray[np.bool_], pixel: NDArray[np.float64], used: NDArray[np.bool_] | None = None
) -> Fan | Rectangle | None:
    """Fit the fan or the rectangle that was scanned; None where neither fits.

    Pixels ``seen`` (rows, columns) are not black; ``pixel`` is m from column to column and from row
    to row. Of pixels ``used``, all without it, edges on their border may cut a fan.
    """
    within = np.ones_like(seen) if used is None else used
    body = _body(seen & within)
    if body is None:
        return None
    z, x = np.indices(body.shape) * pixel[::-1, None, None]
    best: Fan | Rectangle | None = None
    least = _ALIKE
    for part in (_rectangle(body, pixel), _fan(body, within, pixel)):
        if part is not None:
            inside = part.contains(x, z) & within
            overlap = int((inside & body).sum()) / max(1, int((inside | body).sum()))
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
    if ends > farthest + 2.0:  # pixels; `make_image_mask` leaves out the border
        ends = float(farthest)
    x, z = (float(place) for place in np.array(part.fan_origin) * pixel)
    side = float(pixel.mean())
    return Fan((x, z), (begins * side, ends * side), part.fan_angles)


def _body(seen: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """Return the largest connected part, without its holes; letters beside it are others."""
    around, small = np.pad(seen, 1), np.ones((3, 3))
    smooth = binary_opening(binary_fill_holes(binary_closing(around, small)), small)
    parts, count = connected_parts(smooth[1:-1, 1:-1])
    if not count:
        return None
    return np.asarray(parts == int(np.argmax(np.bincount(parts.reshape(-1))[1:])) + 1)


def _rectangle(body: NDArray[np.bool_], pixel: NDArray[np.float64]) -> Rectangle:
    """Return the rectangle whose edges are the medians of a part's edges."""
    sides = []
    for lines, side in ((body, pixel[0]), (body.T, pixel[1])):
        lines = lines[lines.any(axis=1)]
        first = float(np.median(lines.argmax(axis=1))) - 0.5
        last = lines.shape[1] - 0.5 - float(np.median(lines[:, ::-1].argmax(axis=1)))
        sides.append((first * float(side), last * float(side)))
    return Rectangle(*sides)


def _fan(
    body: NDArray[np.bool_], within: NDArray[np.bool_], pixel: NDArray[np.float64]
) -> Fan | None:
    """Return the fan on whose edges the border of a part lies, but for where the image cuts it."""
    border = body & ~binary_erosion(body) & binary_erosion(within)
    rows = np.flatnonzero(body.any(axis=1))
    first = body[rows].argmax(axis=1)
    last = body.shape[1] - 1 - body[rows, ::-1].argmax(axis=1)
    sides = []  # at first: slope and place of a line through each
    for side, widest in ((first, first.argmin()), (last, last.argmax())):
        free = np.flatnonzero(border[rows, side] & (np.arange(len(rows)) <= widest))
        if len(free) < max(_LEAST_POINTS, 0.25 * len(rows)):
            return None
        some = free[:: 1 + len(free) // 200]
        sides.append(theilslopes(side[some] * pixel[0], rows[some] * pixel[1])[:2])
    (slope, base), (other, further) = sides
    if math.atan(other) - math.atan(slope) < _NARROW:
        return None
    z = (base - further) / (other - slope)
    apex = np.array([slope * z + base, z])
    points = np.argwhere(border)[:, ::-1] * pixel  # (N, 2) m, x and z
    radius = np.hypot(*(np.argwhere(body)[:, ::-1] * pixel - apex).T)

    def off(shape: NDArray[np.float64] | list[float]) -> NDArray[np.float64]:
        """m, from points to the nearest of the fan's four edges."""
        x, z, first, last, begins, ends = shape
        across, down = points[:, 0] - x, points[:, 1] - z
        radius = np.hypot(across, down)
        sides = [across * math.cos(each) - down * math.sin(each) for each in (first, last)]
        return np.asarray(np.abs([*sides, radius - begins, radius - ends]).min(axis=0))

    fitted = least_squares(
        off,
        [*apex, math.atan(slope), math.atan(other), radius.min(), radius.max()],
        loss="soft_l1",
        f_scale=float(pixel.max()),
        x_scale=[1e-3, 1e-3, 1e-2, 1e-2, 1e-3, 1e-3],
    )
    x, z, start, end, begins, ends = map(float, fitted.x)
    if not (0.0 <= begins < ends and end - start > _NARROW):
        return None
    # From the centres of the outermost pixels to their border, which is half a pixel farther out.
    side = 0.5 * float(pixel.mean())
    back, middle = side / math.sin(0.5 * (end - start)), 0.5 * (start + end)
    placed = (x - back * math.sin(middle), z - back * math.cos(middle))
    return Fan(placed, (max(0.0, begins + back - side), ends + back + side), (start, end))


def _probe(shape: Fan | Rectangle) -> ProbeSettings | None:
    """Return the transducer that scans a shape; None where it is none of the usual ones."""
    values: dict[str, float] = {}
    if isinstance(shape, Rectangle):
        kind, values["aperture"] = "linear", shape.x[1] - shape.x[0]
        if values["aperture"] > 0.08:  # m: a wider rectangle is something else
            return None
    else:
        values["opening_angle"] = shape.angles[1] - shape.angles[0]
        # Images do not show the aperture, m; this is that of usual phased arrays.
        is_point = shape.radius[0] < _POINT
        kind = "sector" if is_point else "convex"
        values |= {"aperture": 0.02} if is_point else {"radius": shape.radius[0]}
    values["depth"] = _middle_beam(shape)[2]
    made: Any = PROBES.load_settings(kind)
    try:
        array = ChosenOption(kind, made(**{key: round(value, 5) for key, value in values.items()}))
    except UsSimError:  # out of the range of probes
        return None
    return ProbeSettings(array=array, image=512)


def _middle_beam(
    shape: Fan | Rectangle,
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return where it leaves the face (2,) m, its direction (2,), and its length, m."""
    if isinstance(shape, Rectangle):
        face = np.array([0.5 * sum(shape.x), shape.z[0]])
        return face, np.array([0.0, 1.0]), shape.z[1] - shape.z[0]
    angle = 0.5 * sum(shape.angles)
    ahead = np.array([math.sin(angle), math.cos(angle)])
    begins = shape.radius[0] if shape.radius[0] >= _POINT else 0.0
    return shape.apex + begins * ahead, ahead, shape.radius[1] - begins


def _poses(
    sweep: TrackedSweep, shape: Fan | Rectangle, pixel: NDArray[np.float64]
) -> tuple[Placement, ...]:
    """Return poses of the middle of the probe's face at frames all over a sweep."""
    face, ahead, _ = _middle_beam(shape)
    poses = []
    for matrix in sweep.image_to_reference[_spread(sweep, 33)]:
        across, down = (matrix[:3, :2] / np.linalg.norm(matrix[:3, :2], axis=0)).T
        z = ahead[0] * across + ahead[1] * down
        z /= np.linalg.norm(z)
        x = across - (across @ z) * z
        x /= np.linalg.norm(x)
        turned = Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z])).as_quat()
        poses.append(round_pose(Pose(matrix[:3] @ [*(face / pixel), 0.0, 1.0], turned)))
    return tuple(poses)


def _spread(sweep: TrackedSweep, most: int) -> NDArray[np.int64]:
    """Return indices of so many frames, evenly over a sweep; of all where there are fewer."""
    count = len(sweep.numbers)
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
