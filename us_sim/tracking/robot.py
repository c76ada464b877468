"""A robot arm that holds the probe: velocities are asked for, or a force along the probe's axis.

The arm is its flange: where it may go and how fast, without joints. Along the axis it can give way
to the tissue by an admittance without mass, a damper: it moves at (wanted - felt) / damping.

>>> from us_sim.tracking.robot import Robot, RobotSettings
>>> robot = Robot(RobotSettings(damping=400.0, lift="10 mm"))
>>> robot.request_force(0.0, 4.0)
>>> robot.update_force(0.0, 3.0)
>>> [round(1e3 * float(robot.move_until(time).position[2]), 3) for time in (0.0, 0.1)]  # mm
[-10.0, -9.75]
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import exp, rotation_log
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

LONGEST_STEP = 0.1
"""s, that one motion may make up for where the computer was late."""


class _Reach(Protocol):
    """Farthest places (m) and turn (rad) of a probe from the origin of ``patient`` and no turn."""

    @property
    def aside(self) -> float: ...
    @property
    def lift(self) -> float: ...
    @property
    def press(self) -> float: ...
    @property
    def lean(self) -> float: ...


def clip_to_reach(pose: Pose, before: Pose, reach: _Reach) -> Pose:
    """Clip a pose's place to the reach, and keep the turn before where it leads beyond it."""
    low = [-reach.aside, -reach.aside, -reach.lift]
    position = np.clip(pose.position, low, [reach.aside, reach.aside, reach.press])
    leans = float(np.linalg.norm(rotation_log(pose.orientation))) > reach.lean
    return Pose(position, before.orientation if leans else pose.orientation)


def compute_approach_speed(wanted: float, felt: float, damping: float, most: float) -> float:
    """Return the speed (m/s) along the probe's axis by which an admittance seeks a force.

    Against tissue of k N/m, felt T s late, the force obeys f' = (k / damping) (wanted - f(t - T)).
    It settles for k T / damping < π / 2, and without overshoot up to 1 / e (Hayes, Roots of the
    transcendental equation associated with a certain difference-differential equation, 1950).

    Args:
        wanted: N, by which the probe is to press.
        felt: N, by which it presses.
        damping: N s/m.
        most: m/s.
    """
    return min(max((wanted - felt) / damping, -most), most)


@dataclass(frozen=True)
class RobotSettings(Settings):
    """Settings of the robot arm: limits of its motion and of its reach."""

    error = TrackingError

    rate: float = setting(Quantity("frequency", 1.0, 1000.0), "of poses and control", default=60.0)
    damping: float = setting(
        Quantity("number", 1.0, 1e6),
        "N s/m, of the admittance along the probe's axis; without overshoot from 2.7 times the "
        "tissue's stiffness (N/m) times the delay of its force (s)",
        default=400.0,
    )
    force: float = setting(Quantity("force", 0.1, 200.0), "largest wanted force", default=25.0)
    timeout: float = setting(
        Quantity("time", 0.01, 60.0),
        "after which a command or a felt force counts no longer, and the arm stops",
        default=0.3,
    )
    speed: float = setting(Quantity("speed", 1e-4, 2.0), "highest of the probe", default=0.05)
    angular_speed: float = setting(Quantity("angular speed", 1e-3, 10.0), "highest", default=0.6)
    acceleration: float = setting(
        Quantity("number", 0.01, 1000.0), "highest of the probe, m/s²", default=1.0
    )
    angular_acceleration: float = setting(
        Quantity("number", 0.01, 1e4), "the highest, rad/s²", default=10.0
    )
    aside: float = setting(
        Quantity("length", 0.0, 2.0), "farthest from the scene's start along x, y", default=0.1
    )
    lift: float = setting(
        Quantity("length", 0.0, 2.0), "highest above it, where the arm begins", default=0.02
    )
    press: float = setting(Quantity("length", 0.0, 0.2), "deepest below it", default=0.025)
    lean: float = setting(
        Quantity("angle", 0.0, 1.5), "farthest turn from the scene's start", default=0.6
    )


class Robot:
    """An arm with its probe above the origin of ``patient``; all times are s of one clock."""

    def __init__(self, settings: RobotSettings) -> None:
        self._settings = settings
        self.pose = Pose(np.array([0.0, 0.0, -settings.lift]))
        self._velocity = np.zeros(6)  # of the probe in its own frame
        self._time: float | None = None  # of the last motion
        self._twist: tuple[float, NDArray[np.float64]] = (-math.inf, np.zeros(6))
        self._wanted = self._felt = (-math.inf, 0.0)
        self.action = "at rest"  # for a person

    def request_velocity(
        self, time: float, twist: NDArray[np.float64], *, in_patient: bool = False
    ) -> None:
        """Ask for a velocity (6,) m/s, rad/s along the axes of the probe, or of ``patient``."""
        if in_patient:
            twist = (twist.reshape(2, 3) @ self.pose.rotation).ravel()
        self._twist = time, twist

    def request_force(self, time: float, force: float) -> None:
        """Ask for a force, N by which the probe presses along its axis."""
        self._wanted = time, force

    def update_force(self, time: float, force: float) -> None:
        """Set the force, N by which the probe presses along its axis."""
        self._felt = time, force

    def move_until(self, time: float) -> Pose:
        """Move until a time, and return the probe's pose in ``patient``."""
        given = self._settings
        passed = 0.0 if self._time is None else min(max(time - self._time, 0.0), LONGEST_STEP)
        self._time = time
        change = self._wanted_velocity(time) - self._velocity
        self._velocity[:3] += _shorten(change[:3], given.acceleration * passed)
        self._velocity[3:] += _shorten(change[3:], given.angular_acceleration * passed)
        moved = self.pose @ exp(self._velocity * passed)
        self.pose = clip_to_reach(moved, self.pose, given)
        return self.pose

    def _wanted_velocity(self, time: float) -> NDArray[np.float64]:
        given = self._settings
        velocity = np.zeros(6)
        self.action = "at rest"
        if time - self._twist[0] <= given.timeout:
            velocity[:] = self._twist[1]
            self.action = "following a velocity"
        if time - self._wanted[0] <= given.timeout:
            wanted = min(max(self._wanted[1], 0.0), given.force)
            if time - self._felt[0] <= given.timeout:
                velocity[2] = compute_approach_speed(
                    wanted, self._felt[1], given.damping, given.speed
                )
                self.action = f"seeking {wanted:.1f} N"
            else:
                velocity[2] = 0.0
                self.action = "without a felt force"
        velocity[:3] = _shorten(velocity[:3], given.speed)
        velocity[3:] = _shorten(velocity[3:], given.angular_speed)
        return velocity


def _shorten(vector: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """Shorten a vector to a length."""
    length = float(np.linalg.norm(vector))
    return vector * (most / length) if length > most else vector
