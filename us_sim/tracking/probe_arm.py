"""A robot arm that holds the probe: it follows a velocity, or seeks a force by an admittance.

An admittance turns a force into a motion (Hogan, 1985): m dv/dt + d v = wanted - felt. Against
tissue of stiffness k, whose force acts on the motion up to T later, the contact is stable for any
mass m if k T < d: by the small gain theorem (Gu, Kharitonov and Chen, Stability of Time-Delay
Systems, 2003), since what the probe moved within T changes the force by k T times its velocity at
most, and the admittance on the tissue answers a force with 1 / d times that velocity at most.
Without mass and with a constant T it is stable for k T < π d / 2, and not beyond (Hayes, 1950).
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import exp, rotation_log

if TYPE_CHECKING:
    from us_sim.scene.episode import EpisodeSettings, RobotSettings


def admittance(
    force: float, damping: float, *, mass: float = 0.0, velocity: float = 0.0, period: float = 1.0
) -> float:
    """The velocity (m/s) after a period (s) of a force (N), by implicit Euler.

    Args:
        force: wanted less felt.
        damping: N s/m.
        mass: kg.
        velocity: before.
        period: s; it does not matter without mass.
    """
    return (mass * velocity + period * force) / (mass + period * damping)


def within_reach(pose: Pose, before: Pose, given: EpisodeSettings) -> Pose:
    """The pose in ``patient``, within the space around the scene's start that the probe may be in.

    Args:
        pose: that is wanted.
        before: whose orientation stays where the wanted one leans too far.
        given: limits.
    """
    low = [-given.aside, -given.aside, -given.lift]
    position = np.clip(pose.position, low, [given.aside, given.aside, given.press])
    leans = float(np.linalg.norm(rotation_log(pose.orientation))) > given.lean
    return Pose(position, before.orientation if leans else pose.orientation)


class ProbeArm:
    """Moves a probe in frame ``patient``; it begins upright, at the highest place above the start.

    Args:
        robot: rate, delay and dynamics.
        given: limits of speed, force and space.
    """

    def __init__(self, robot: RobotSettings, given: EpisodeSettings) -> None:
        self._robot, self._given = robot, given
        self.pose = Pose([0.0, 0.0, -given.lift])
        self._velocity = np.zeros(6)
        delay = round(robot.delay * robot.rate)
        self._late = deque([self._velocity] * (delay + 1), maxlen=delay + 1)

    def move(self, twist: NDArray[np.float64], felt: float, wanted: float | None = None) -> Pose:
        """The pose one period later.

        Args:
            twist: (6,) m/s, rad/s wanted, linear and angular, in the probe's frame.
            felt: N, by which the tissue pushes the probe back along its axis.
            wanted: N of the same, sought in place of the axial velocity; without, the probe gives
                way where the largest force is exceeded.
        """
        robot, given, period = self._robot, self._given, 1.0 / self._robot.rate
        fastest = np.repeat([given.speed, given.angular_speed], 3)
        change = fastest * min(robot.acceleration * period / given.speed, 2.0)
        velocity = np.clip(twist, -fastest, fastest)
        velocity = np.clip(velocity, self._velocity - change, self._velocity + change)
        target = given.force if wanted is None else min(max(wanted, 0.0), given.force)
        sought = admittance(
            target - felt,
            given.damping,
            mass=robot.mass,
            velocity=float(self._velocity[2]),
            period=period,
        )
        velocity[2] = min(velocity[2], sought) if wanted is None else sought
        self._velocity = np.clip(velocity, -fastest, fastest)
        self._late.append(self._velocity)
        self.pose = within_reach(self.pose @ exp(self._late[0] * period), self.pose, given)
        return self.pose
