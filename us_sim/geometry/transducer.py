"""The transducer: its settings in a scene or a case, and a mesh of it to look at.

The mesh is made of rings around the probe's z axis. A ring is the outline of a box grown by a
rounding: along the box's sides and round its corners, always with as many points, so that two
rings make a band of triangles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import SceneError
from us_sim.geometry.collider import Collider
from us_sim.settings.choice import ChosenOption
from us_sim.settings.quantity import Quantity
from us_sim.settings.registry import COLLIDERS, PROBES
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class ProbeSettings(Settings):
    """The transducer: its geometry, the image it makes, and the shape that presses."""

    section = "probe"
    error = SceneError

    array: ChosenOption = setting(
        description="kind of transducer",
        choice=PROBES,
        place="beside",
        default=ChosenOption("linear"),
    )
    image: tuple[int, int] | int | None = setting(
        Quantity("number", 1, 4096),
        "[columns, rows], or the number of rows of square pixels; not given: [512, 512] of a "
        "linear array, else 512",
        default=None,
    )
    collider: ChosenOption | None = setting(
        description="shape that presses", choice=COLLIDERS, default=None
    )

    @property
    def geometry(self) -> str:
        """The kind of transducer."""
        return self.array.name


Colour = tuple[float, float, float]
# Parts of a ring's long sides, of each of its corners, and of the rounding from front to side.
_ALONG, _ROUND, _LATITUDES = 16, 6, 6
_NOSE = 0.006  # m, of the face's part that is straight behind its rounding
# m, lengths of the taper, the grip, its rounded end, and the cable's stub.
_SHOULDER, _GRIP, _END, _CABLE = 0.022, 0.058, 0.010, 0.065
_CABLE_RADIUS = 0.0028
_NOTCH = (0.0016, 0.0022, 0.009)  # m, half the orientation notch's height, width and length
FACE, HOUSING = (0.20, 0.23, 0.26), (0.86, 0.88, 0.89)
CABLE, NOTCH = (0.13, 0.14, 0.16), (0.31, 0.70, 0.75)


@dataclass(frozen=True, eq=False)
class TransducerPart:
    """A closed surface in frame ``probe``."""

    name: str
    colour: Colour  # red, green, blue, 0 to 1
    vertices: NDArray[np.float64]  # (V, 3) m
    triangles: NDArray[np.int32]  # (T, 3), counter-clockwise seen from outside


def build_transducer_mesh(collider: Collider) -> list[TransducerPart]:
    """Build the parts of a transducer whose face has the shape of ``collider``."""
    half_x, half_y, _, rounding, *bent = collider.offset_box.tolist()
    front, side = _face_rings(half_x, half_y, rounding, *bent)
    top = float(side[:, 2].min()) - _NOSE
    end = top - _SHOULDER - _GRIP
    face = np.array([half_x, half_y, rounding])
    nose = _flat_ring(face, top)
    width, depth = 2 * (half_x + rounding), 2 * (half_y + rounding)
    grip_x = min(max(0.62 * width, 0.024), 0.034) / 2  # as a hand holds it
    grip_y = min(max(1.15 * depth, 0.018), 0.024) / 2
    # From a box of the face's shape to a rounder one of the grip's.
    round_grip = 0.9 * min(grip_x, grip_y)
    grip = np.array([grip_x - round_grip, grip_y - round_grip, round_grip])
    housing = [nose]
    for part in np.linspace(0.0, 1.0, 9)[1:]:
        ease = 0.5 - 0.5 * math.cos(math.pi * part)
        housing.append(_flat_ring((1 - ease) * face + ease * grip, top - _SHOULDER * part))
    # The end is rounded: an ellipse's quarter, into which the cable leads.
    for angle in np.radians([0.0, 25.0, 50.0, 70.0, 85.0]):
        housing.append(_flat_ring(math.cos(angle) * grip, end - _END * math.sin(angle)))
    cable = [_flat_ring([0.0, 0.0, _CABLE_RADIUS], end - way) for way in (0.0, _END + _CABLE)]
    high, wide, long = _NOTCH
    # At -x, on the side of the image's first column: the mark is at the image's left.
    circle = _flat_ring([0.0, 0.0, wide], 0.0)[:, [2, 0, 1]]  # around x
    notch = [
        circle * [1.0, *size] + [-grip_x - high * out, 0.0, top - _SHOULDER - 0.012]
        for out, size in ((-0.8, (1.0, long / wide)), (0.2, (1.0, long / wide)), (1.0, (0.6, 3.0)))
    ]
    return [
        _build_part("face", FACE, [*front, side, nose], has_front=False),
        _build_part("housing", HOUSING, housing),
        _build_part("cable", CABLE, cable),
        _build_part("notch", NOTCH, notch),
    ]


def _outline(half_x: float, half_y: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points (P, 2) of a box's outline and outward directions (P, 2), from +y to +x.

    The same number of points for every box, those of a side that has no length at one place.
    """
    along = np.linspace(-half_x, half_x, _ALONG + 1)
    turn = np.linspace(0.0, 0.5 * math.pi, _ROUND + 1)
    points, directions = [], []
    for quarter, (x, y) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1))):
        if quarter in (0, 2):  # along the front and the back before their second corner
            points.append(np.column_stack([x * along, np.full_like(along, y * half_y)])[:-1])
            directions.append(np.tile([0.0, float(y)], (_ALONG, 1)))
        angle = (0.5 - 0.5 * quarter) * math.pi - turn
        points.append(np.tile([x * half_x, y * half_y], (_ROUND + 1, 1)))
        directions.append(np.column_stack([np.cos(angle), np.sin(angle)]))
    return np.concatenate(points), np.concatenate(directions)


def _flat_ring(size: ArrayLike, z: float) -> NDArray[np.float64]:
    """Return the outline (P, 3) m, at a height z, of a box of half x and y, grown by a rounding."""
    half_x, half_y, rounding = np.asarray(size).tolist()
    points, directions = _outline(half_x, half_y)
    ring = points + rounding * directions
    return np.column_stack([ring, np.full(len(ring), z)])


def _face_rings(
    half_x: float, half_y: float, rounding: float, curvature: float = 0.0
) -> tuple[list[NDArray], NDArray]:
    """Return rings on the collider: of the front, from its middle line outwards; and of the side.

    A point of a ring is one of the core's front, grown by the rounding along a normal there: of
    those between the front's own and the outline's direction.
    """
    middle, directions = _outline(half_x, 0.0)
    edge, _ = _outline(half_x, half_y)
    outward = np.column_stack([directions, np.zeros(len(directions))])
    front = np.column_stack([curvature * edge[:, 0], np.zeros(len(edge)), np.zeros(len(edge))])
    front[:, 2] = np.sqrt(1.0 - front[:, 0] ** 2)
    height = -(1.0 - front[:, 2]) / curvature if curvature else np.zeros(len(edge))
    core = np.column_stack([edge, height - rounding])
    rings = [np.column_stack([middle, height]) + rounding * (front - [0.0, 0.0, 1.0])]
    cosine = np.einsum("pa,pa->p", front, outward)
    between = np.arccos(np.clip(cosine, -1.0, 1.0))[:, None]
    for part in np.linspace(0.0, 1.0, _LATITUDES + 1):
        normal = np.sin((1 - part) * between) * front + np.sin(part * between) * outward
        rings.append(core + rounding * normal / np.sin(between))
    return rings[:-1], rings[-1]


def _build_part(
    name: str, colour: Colour, rings: Sequence[NDArray], has_front: bool = True
) -> TransducerPart:
    """Join rings by bands, and close them by flat ends; merge points at the same place.

    A first ring that is a line needs no front.
    """
    count = len(rings[0])
    vertices = np.concatenate([*rings, [rings[0].mean(axis=0), rings[-1].mean(axis=0)]])
    here = np.arange(count)
    there = np.roll(here, -1)
    triangles = []
    for a in range(0, count * (len(rings) - 1), count):
        b = a + count
        triangles.append(np.column_stack([a + here, a + there, b + there]))
        triangles.append(np.column_stack([a + here, b + there, b + here]))
    first, last = len(vertices) - 2, len(vertices) - 1
    if has_front:
        triangles.append(np.column_stack([np.full(count, first), there, here]))
    back = (len(rings) - 1) * count
    triangles.append(np.column_stack([np.full(count, last), back + here, back + there]))
    places = np.rint(vertices * 1e9)  # vertices at the same nanometre are one
    _, known, which = np.unique(places, axis=0, return_index=True, return_inverse=True)
    corners = which.ravel()[np.concatenate(triangles)]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]  # others vanish
    used, corners = np.unique(corners, return_inverse=True)
    corners = corners.reshape(-1, 3)
    return TransducerPart(name, colour, vertices[known][used], corners.astype(np.int32))
