"""A hand that holds the probe on the skin: the stance it is asked for, and a smooth way there.

The motions are those of the American Institute of Ultrasound in Medicine ("Transducer
Manipulation", Journal of Ultrasound in Medicine 18, 1999, 169-175): sliding along the skin,
compressing along its normal, rotating about it, fanning about the probe's x axis (the array), and
rocking about its y axis, within the image plane.

>>> from us_sim.tracking.virtual_hand import StanceMotion, StandingSurface, Stance
>>> square = np.array([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0], [-0.1, 0.1, 0.0]])
>>> skin = StandingSurface(square, np.array([[0, 2, 1], [0, 3, 2]]))
>>> pressed = Stance([0.02, 0.0, 0.0], press=0.005, fan=math.radians(10))
>>> (1e3 * pressed.compute_pose(skin).position).round(6).tolist()  # mm
[20.0, 0.0, 5.0]
>>> again = Stance.from_pose(pressed.compute_pose(skin), skin)
>>> round(1e3 * again.press, 6), round(math.degrees(again.fan), 6)
(5.0, 10.0)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError, PoseError
from us_sim.geometry.pose import Pose, multiply_quaternions
from us_sim.geometry.se3 import rotation_exp

_TURNS, _NEAR = 30, 1e-9
"""Most improvements of the foot of a perpendicular, and the error (m) that ends them."""
_FACING_UP = 0.3
"""Cosine between -z and the normals of a closed surface's upper side, which is more than this."""
_LEAST_FACING = 0.1
"""The least of these by which a height is found along z."""


@dataclass(frozen=True, eq=False)
class Foot:
    """A place on the surface on which something stands."""

    point: NDArray[np.float64]  # (3,) m, on the surface, frame patient
    normal: NDArray[np.float64]  # (3,) unit length, out of the body, without jumps along the skin


class StandingSurface:
    """Triangles whose normals are made smooth, since a probe on facets would jerk at their edges.

    The normal at a point is interpolated between those of its triangle's corners (Phong 1975), and
    a corner's is the mean of its triangles', weighted by their areas.

    Args:
        vertices: (N, 3) m, frame ``patient``.
        triangles: (T, 3) indices into them, anticlockwise as seen from outside the body.

    Raises:
        MeshError: no triangle has an area.
    """

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> None:
        vertices = np.asarray(vertices, dtype=np.float64)
        triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
        corners = vertices[triangles]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        proper = np.linalg.norm(across, axis=1) > 0.0
        if not proper.any():
            raise MeshError("the skin has no triangle with an area, so no probe can stand on it")
        sums = np.zeros_like(vertices)
        np.add.at(sums, triangles, across[:, None, :])
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        normals = np.divide(sums, lengths, out=sums, where=lengths > 0.0)
        self._corners = corners[proper]  # (T, 3, 3) m
        self._normals = normals[triangles[proper]]  # (T, 3, 3)
        self._flat = across[proper] / np.linalg.norm(across[proper], axis=1, keepdims=True)
        self._centres = self._corners.mean(axis=1)
        self._radii = np.linalg.norm(self._corners - self._centres[:, None], axis=2).max(axis=1)
        self.lower: NDArray[np.float64] = self._corners.min(axis=(0, 1))
        self.upper: NDArray[np.float64] = self._corners.max(axis=(0, 1))
        """(3,) m, the corners of the box around it."""

    @classmethod
    def create_upper_side(
        cls, vertices: NDArray[np.floating], triangles: NDArray[np.integer]
    ) -> StandingSurface:
        """Make the part of a closed surface that faces -z, on which a probe can stand.

        Arguments are as for the class itself.

        Raises:
            MeshError: as the class itself; nothing of it faces -z.
        """
        a, b, c = (np.asarray(vertices, dtype=np.float64)[triangles[:, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        faces_up = -across[:, 2] > _FACING_UP * np.linalg.norm(across, axis=1)
        return cls(vertices, triangles[faces_up])

    def find_closest(self, point: NDArray[np.float64]) -> Foot:
        """Find the surface's closest point to one (3,) m."""
        offsets = self._centres - point
        distances = np.sqrt(np.einsum("tx,tx->t", offsets, offsets))
        # No other triangle's sphere comes as near as the nearest centre.
        near = np.flatnonzero(distances - self._radii <= distances.min())
        corners = self._corners[near]
        weights = _closest_weights(corners, point)
        off = np.einsum("tc,tcx->tx", weights, corners) - point
        best = int(np.einsum("tx,tx->t", off, off).argmin())
        return self._foot(int(near[best]), weights[best])

    def find_top(self, x: float, y: float) -> Foot:
        """Find the point of the surface's top at x, y (m), or near it where there is none.

        It is the closest to a point on the line along z, which then is put on its tangent plane.
        """
        height = float(self.lower[2])
        for _ in range(_TURNS):
            foot = self.find_closest(np.array([x, y, height]))
            aside = np.array([x, y]) - foot.point[:2]
            if float(np.abs(aside).max()) < _NEAR:
                break
            slope = aside @ foot.normal[:2] / max(-float(foot.normal[2]), _LEAST_FACING)
            height = float(foot.point[2] + slope)
        return foot

    def find_foot(self, position: NDArray[np.float64]) -> tuple[Foot, float]:
        """Find the foot on whose normal a position (3,) m lies, and its distance inwards (m).

        Near the edge of a surface that is not closed there may be none: then it is the closest.
        """
        point = position
        for _ in range(_TURNS):
            foot = self.find_closest(point)
            offset = position - foot.point
            inwards = -float(offset @ foot.normal)
            aside = offset + inwards * foot.normal
            if float(np.abs(aside).max()) < _NEAR:
                return foot, inwards
            point = foot.point + aside
        foot = self.find_closest(position)
        return foot, -float((position - foot.point) @ foot.normal)

    def _foot(self, triangle: int, weights: NDArray[np.float64]) -> Foot:
        normal = weights @ self._normals[triangle]
        length = float(np.linalg.norm(normal))
        # Where triangles fold onto each other their normals may cancel.
        normal = normal / length if length > 1e-9 else self._flat[triangle]
        return Foot(weights @ self._corners[triangle], normal)


def _closest_weights(
    corners: NDArray[np.float64], point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return weights (T, 3) of the points of triangles (T, 3, 3) m closest to one (3,) m."""
    sides = np.roll(corners, -1, axis=1) - corners  # of each corner to the next
    to = point - corners
    across = np.cross(sides[:, 0], sides[:, 1])
    # The areas opposite to the corners, where the plane's closest point is in the triangle.
    opposite = np.roll(np.cross(sides, to), -1, axis=1)
    inside = np.einsum("tcx,tx->tc", opposite, across) / (across**2).sum(axis=1, keepdims=True)
    along = (to * sides).sum(axis=2) / (sides**2).sum(axis=2)
    along = np.clip(along, 0.0, 1.0)
    off = ((to - along[..., None] * sides) ** 2).sum(axis=2)
    rows, nearest = np.arange(len(corners)), off.argmin(axis=1)
    on_side = np.zeros((len(corners), 3))
    on_side[rows, nearest] = 1.0 - along[rows, nearest]
    on_side[rows, (nearest + 1) % 3] = along[rows, nearest]
    return np.where((inside >= 0.0).all(axis=1, keepdims=True), inside, on_side)


class Approach:
    """One quantity of a movement, of any number of coordinates.

    Its speed is never above ``speed``, its acceleration never above
    ``2 * speed / time_constant``, and half of that from rest. It stays within the triangle of
    its place, its lead's and the goal: from rest, on the straight line to the goal.

    Args:
        place: (K,) where it rests.
        speed: the largest, in the unit of the place per s.
        time_constant: s.
    """

    def __init__(self, place: NDArray[np.float64], speed: float, time_constant: float) -> None:
        self._speed, self._time_constant = speed, time_constant
        self.place = np.array(place, dtype=np.float64)
        self._lead = self.place.copy()
        self.goal: NDArray[np.float64] = self.place.copy()

    def compute_distance(self) -> float:
        """Return the distance to the goal of it or its lead, the larger."""
        return max(math.dist(self.goal, self._lead), math.dist(self.goal, self.place))

    def advance(self, seconds: float) -> NDArray[np.float64]:
        """Advance by seconds, and return the place (K,)."""
        way = self.goal - self._lead
        distance, tau = math.hypot(*way), self._time_constant
        fast = max(distance / self._speed - tau, 0.0)  # s until the lead slows down
        if fast > 0.0:
            passed = min(seconds, fast)
            velocity = way * (self._speed / distance)
            lag = self.place - self._lead + tau * velocity
            self._lead = self._lead + passed * velocity
            self.place = self._lead - tau * velocity + math.exp(-passed / tau) * lag
            seconds -= passed
        if seconds > 0.0:
            way, decay = self.goal - self._lead, math.exp(-seconds / tau)
            self.place = self.goal + decay * (self.place - self.goal - (seconds / tau) * way)
            self._lead = self.goal - decay * way
        return self.place


_AT_REST, _ALIGNED = 2e-6, 1e-4  # m and rad from the goal: it is reached, for a pixel is some 80 µm


# A hand is as fast as a quick sonographer's at most, far below a thrust.
_SLIDING = 0.25  # m/s, of the line from the one point of the skin to the other
_PRESSING = 0.15  # m/s
_TURNING = math.pi  # rad/s, of rotation, fan and rock together, against the skin
_TIME_CONSTANT = 0.02  # s; following a slow mouse, the probe is twice that behind


class StanceMotion:
    """Takes the probe to the stance that was asked for last.

    Sliding, pressing and turning each go at their own pace, see `Approach`. The way from one
    point of the skin to another is a straight line; the probe stands on the skin closest to it,
    so it goes over the skin of an arm and not through it.
    """

    def __init__(self, stance: Stance) -> None:
        point, press, turn = _split(stance)
        self._slide = Approach(point, _SLIDING, _TIME_CONSTANT)
        self._press = Approach(press, _PRESSING, _TIME_CONSTANT)
        self._turn = Approach(turn, _TURNING, _TIME_CONSTANT)
        self._approaches = self._slide, self._press, self._turn

    @property
    def stance(self) -> Stance:
        """The stance now."""
        return _stance(self._slide.place, self._press.place, self._turn.place)

    @property
    def goal(self) -> Stance:
        """The stance that it goes to."""
        return _stance(self._slide.goal, self._press.goal, self._turn.goal)

    @property
    def is_at_rest(self) -> bool:
        """The goal is reached."""
        metres = max(self._slide.compute_distance(), self._press.compute_distance())
        return metres < _AT_REST and self._turn.compute_distance() < _ALIGNED

    def aim_at(self, stance: Stance) -> None:
        """Go to a stance from now on, turning the shorter way."""
        self._slide.goal, self._press.goal, turn = _split(stance)
        turn[0] = self._turn.place[0] + wrap_angle(turn[0] - self._turn.place[0])
        self._turn.goal = turn

    def advance(self, seconds: float) -> Stance:
        """Advance by seconds, and return the stance."""
        for approach in self._approaches:
            approach.advance(seconds)
        return self.stance


def _split(stance: Stance) -> tuple[NDArray[np.float64], ...]:
    """Split a stance into the point (3,) m, the press (1,) m and the turn (3,) rad."""
    turn = np.array([stance.rotation, stance.fan, stance.rock])
    return stance.point.copy(), np.array([stance.press]), turn


def _stance(
    point: NDArray[np.float64], press: NDArray[np.float64], turn: NDArray[np.float64]
) -> Stance:
    rotation, fan, rock = turn.tolist()
    return Stance(point, float(press[0]), wrap_angle(rotation), fan, rock)


_AXES = np.eye(3)
DEEPEST = 0.02  # m that a probe is pressed at most: a vein closes at half of it, and deeper hurts
HIGHEST = 0.05  # m that it is lifted off at most
STEEPEST = math.radians(60)
"""rad that it is fanned or rocked at most: more, and its grip would lie on the skin."""


@dataclass(frozen=True, eq=False)
class Stance:
    """The probe on the skin at rest.

    Fan and rock are about the middle of the probe's face, which stays where it is.

    Raises:
        PoseError: a number is not finite.
    """

    point: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    # (3,) m, frame patient; what counts is the point of the skin at rest that is closest to it
    press: float = 0.0  # m inwards along the skin's normal; negative is above it
    rotation: float = 0.0  # rad about the normal, from where x is turned as little as can be
    fan: float = 0.0  # rad about the probe's x
    rock: float = 0.0  # rad about the probe's y

    def __post_init__(self) -> None:
        point = np.array(self.point, dtype=np.float64)
        numbers = [*point.ravel(), self.press, self.rotation, self.fan, self.rock]
        if point.shape != (3,) or not np.isfinite(numbers).all():
            raise PoseError(f"the hand's numbers {numbers} are not finite, or not seven")
        point.flags.writeable = False
        object.__setattr__(self, "point", point)

    @classmethod
    def from_pose(cls, pose: Pose, surface: StandingSurface) -> Stance:
        """Find the stance of a probe in a pose: the inverse of `compute_pose`."""
        foot, press = surface.find_foot(pose.position)
        x, y, z, w = _upright(foot.normal)
        turned = Pose(
            np.zeros(3), multiply_quaternions(np.array([-x, -y, -z, w]), pose.orientation)
        ).rotation
        # Rz(rotation) Rx(fan) Ry(rock), taken apart (Diebel 2006, sequence 3-1-2).
        fan = math.asin(float(np.clip(turned[2, 1], -1.0, 1.0)))
        if math.hypot(turned[0, 1], turned[1, 1]) < 1e-9:  # fanned by a quarter turn
            return cls(foot.point, press, math.atan2(turned[1, 0], turned[0, 0]), fan, 0.0)
        rotation = math.atan2(-turned[0, 1], turned[1, 1])
        return cls(foot.point, press, rotation, fan, math.atan2(-turned[2, 0], turned[2, 2]))

    @classmethod
    def create_home(cls, surface: StandingSurface, press: float) -> Stance:
        """Stand upright at the origin of ``patient``, or at the middle of a surface beside it.

        ``press`` is in m.
        """
        middle = 0.5 * (surface.lower + surface.upper)
        inside = (surface.lower[:2] <= 0.0).all() and (surface.upper[:2] >= 0.0).all()
        x, y = (0.0, 0.0) if inside else middle[:2].tolist()
        return cls(surface.find_top(x, y).point, press)

    def compute_pose(self, surface: StandingSurface) -> Pose:
        """Return the pose of the probe in ``patient``."""
        foot = surface.find_closest(self.point)
        orientation = _upright(foot.normal)
        for axis, angle in ((2, self.rotation), (0, self.fan), (1, self.rock)):
            orientation = multiply_quaternions(orientation, rotation_exp(angle * _AXES[axis]))
        return Pose(foot.point - self.press * foot.normal, orientation)

    def slide_along(self, surface: StandingSurface, along_x: float, along_y: float) -> Stance:
        """Slide along the probe's own x and y (m), and stand on the closest point of the skin."""
        foot = surface.find_closest(self.point)
        turned = multiply_quaternions(_upright(foot.normal), rotation_exp(self.rotation * _AXES[2]))
        way = Pose(np.zeros(3), turned).rotation @ np.array([along_x, along_y, 0.0])
        return replace(self, point=surface.find_closest(foot.point + way).point)

    def clip_to_reach(self) -> Stance:
        """Clip press, fan and rock to those of a hand."""
        return replace(
            self,
            press=min(max(self.press, -HIGHEST), DEEPEST),
            rotation=wrap_angle(self.rotation),
            fan=min(max(self.fan, -STEEPEST), STEEPEST),
            rock=min(max(self.rock, -STEEPEST), STEEPEST),
        )


def wrap_angle(angle: float) -> float:
    """Bring an angle (rad) within half a turn to either side."""
    return math.remainder(angle, 2.0 * math.pi)


def _upright(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quaternion (4,) of the smallest turn that brings +z against a normal (3,).

    So x stays along the patient's x as far as the skin lets it. On skin that faces exactly down
    every such turn is half a one: it is then about y.
    """
    x, y, z = (-normal).tolist()
    if z < -1.0 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quaternion = np.array([-y, x, 0.0, 1.0 + z])
    return np.asarray(quaternion / np.linalg.norm(quaternion))
