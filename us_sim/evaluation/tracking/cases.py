"""Bodies of markers, cameras and conditions in which trackers are measured.

>>> from us_sim.evaluation.tracking.cases import TrackingCase
>>> case = TrackingCase("aruco_40mm", "640x480", 0.4, 30.0)
>>> sequence = case.make_sequence(0)
>>> len(sequence), round(float(np.linalg.norm(sequence[2].position)), 6)
(5, 0.4)
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import exp, rotation_exp
from us_sim.share import shared_path
from us_sim.tracking.camera.rendered_views import WEBCAMS, Conditions
from us_sim.tracking.camera.rigid_body import RigidBody, read_rigid_body

Array = NDArray[np.float64]

SMALL, LARGE = WEBCAMS  # images, by their sizes
RIGID_BODY, SINGLE = "rigid_body_6x30mm", "aruco_40mm"
FRAMES = 5
"""Views in a row, as a hand moves the body; a new tracker begins each sequence."""

_RATE = 30.0  # frames per second
_SPEED, _TURNING = 0.05, 0.2  # m/s and rad/s, of the hand
_EXPOSURE = 0.015  # s, in the condition with motion blur
_HASTE = 3.0  # times the hand's speed in that condition

CONDITIONS = {
    "plain": (Conditions(), "a webcam's noise (2 grey levels in the white) in even light"),
    "noise": (Conditions(read_noise=4.0, shot_noise=0.05), "5 grey levels of noise, as at dusk"),
    "blur": (
        Conditions(defocus=1.6),
        f"out of focus by 1.6 pixels, and moving by {_HASTE * _SPEED * _EXPOSURE * 1e3:.1f} mm "
        f"during the exposure",
    ),
    "occlusion": (Conditions(occlusion=0.35), "a hand over a third of the body"),
    "gradient": (Conditions(gradient=0.7), "light that falls by 70 % across the image"),
}
"""Conditions of views, each in settings and in words."""


@dataclass(frozen=True, eq=False)
class Marker:
    """A body of markers, its words in a report, and a function that makes it."""

    words: str
    make: Callable[[], RigidBody]
    facing: tuple[float, float, float] | None = None  # as `front`; None: the first marker's normal

    @cached_property
    def body(self) -> RigidBody:
        """The body, made once."""
        return self.make()

    @cached_property
    def front(self) -> Array:
        """(3,) unit normal of the side that faces the camera at an angle of 0."""
        return self.body.normals[0] if self.facing is None else np.array(self.facing)


MARKERS = {
    SINGLE: Marker("one ArUco marker of 40 mm", lambda: RigidBody.create_single("4X4_50", 7, 0.04)),
    "apriltag_40mm": Marker(
        "one AprilTag of 40 mm", lambda: RigidBody.create_single("APRILTAG_36h11", 7, 0.04)
    ),
    "charuco_board": Marker(
        "ChArUco, 5 × 4 squares of 24 mm, markers of 18 mm",
        lambda: RigidBody.create_charuco("4X4_50", 5, 4, 0.024, 0.018),
    ),
    "grid_board": Marker(
        "4 × 3 ArUco markers of 24 mm, 6 mm apart",
        lambda: RigidBody.create_grid("4X4_50", 4, 3, 0.024, 0.006),
    ),
    RIGID_BODY: Marker(
        "6 markers of 30 mm on three facets, 4 visible at 0°",
        lambda: read_rigid_body(shared_path("config/markers/probe_grip.yaml")),
        # Between its middle facet and the one to the right: these two are seen, at 30° each.
        facing=(0.5, 0.0, math.sqrt(0.75)),
    ),
}
"""By name, in the report's order."""


@dataclass(frozen=True)
class TrackingCase:
    """A body at a distance and an angle, in a condition; the rest is random."""

    marker: str
    image_size: str
    distance: float  # m, from the camera to the body's middle
    angle: float  # degrees, from the line of sight to the body's front
    condition: str = "plain"

    @property
    def key(self) -> str:
        """Text from which random seeds are made, as for the published tables."""
        return repr(self).removeprefix("Tracking")

    def make_sequence(self, number: int) -> list[Pose]:
        """Make `FRAMES` poses of the body in ``camera_optical``; the middle one is the case's."""
        random = np.random.default_rng([zlib.crc32(self.key.encode()), number])
        camera, marker = WEBCAMS[self.image_size], MARKERS[self.marker]
        size = np.array([camera.width, camera.height])
        pixel = size * (0.5 + random.uniform(-0.12, 0.12, 2))
        place = np.append(camera.compute_rays(pixel[None])[0], 1.0)
        place *= self.distance / np.linalg.norm(place)
        about = random.uniform(0, 2 * np.pi)
        tilt = np.radians(self.angle) * np.array([np.cos(about), np.sin(about), 0.0])
        spin = np.array([0.0, 0.0, random.uniform(0, 2 * np.pi)])
        turn = (
            _make_turn(_find_rotation(np.array([0.0, 0.0, 1.0]), place))
            @ _make_turn(tilt)
            @ _make_turn(spin)
            @ _make_turn(_find_rotation(marker.front, np.array([0.0, 0.0, -1.0])))
        )
        middle = marker.body.centres.mean(axis=0)
        asked = Pose(place - turn.rotation @ middle, turn.orientation)
        velocity = self.compute_velocity(number)
        poses = []
        for frame in range(FRAMES):
            moved = exp((frame - FRAMES // 2) / _RATE * velocity)
            # About the body's middle, whose distance is the case's.
            turned = Pose(np.zeros(3), (moved @ asked).orientation)
            position = place + moved.position - turned.rotation @ middle
            poses.append(Pose(position, turned.orientation))
        return poses

    def compute_velocity(self, number: int) -> Array:
        """Compute the velocity (6,) m/s and rad/s in a sequence, along the camera's axes."""
        random = np.random.default_rng([zlib.crc32(self.key.encode()), number, 1])
        directions = random.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        haste = _HASTE if self.condition == "blur" else 1.0
        return haste * np.concatenate([_SPEED * directions[0], _TURNING * directions[1]])

    def compute_motion(self, number: int) -> Array | None:
        """Compute the motion (6,) m and rad during the exposure; None if that is short."""
        return _EXPOSURE * self.compute_velocity(number) if self.condition == "blur" else None


def list_cases(quick: bool) -> list[TrackingCase]:
    """List the cases in the order of the report."""
    distances = (0.4, 0.9) if quick else (0.2, 0.3, 0.4, 0.6, 0.9, 1.3)
    angles = (0.0, 30.0, 60.0) if quick else (0.0, 15.0, 30.0, 45.0, 60.0, 70.0)
    tilted = (30.0,) if quick else (0.0, 30.0, 60.0)
    found = []
    for name in MARKERS:
        found += [TrackingCase(name, SMALL, d, a) for d in distances for a in angles]
        found += [
            TrackingCase(name, SMALL, 0.4, a, c) for c in CONDITIONS if c != "plain" for a in tilted
        ]
        found += [
            TrackingCase(name, LARGE, d, a)
            for d in ((0.4,) if quick else (0.4, 0.9))
            for a in tilted
        ]
        if not quick:
            found += [TrackingCase(name, LARGE, 0.4, 30.0, c) for c in CONDITIONS if c != "plain"]
    return found


def _make_turn(vector: Array) -> Pose:
    return Pose(np.zeros(3), rotation_exp(vector))


def _find_rotation(one: Array, other: Array) -> Array:
    """Find the shortest rotation (3,) rad from one direction to another."""
    one, other = one / np.linalg.norm(one), other / np.linalg.norm(other)
    axis = np.cross(one, other)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.array([np.pi, 0.0, 0.0]) if one @ other < 0 else np.zeros(3)
    return axis / sine * float(np.arctan2(sine, one @ other))
