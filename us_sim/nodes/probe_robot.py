"""Holds the probe as a robot arm does: follows a wanted velocity, and seeks a wanted force."""

from __future__ import annotations

import sys
import time
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped

from us_sim.errors import SceneError
from us_sim.nodes.messages import nanoseconds_of, pose_message, twist_from, wrench_from
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import FOREIGN
from us_sim.nodes.scene_node import LEAD_TOPIC, SceneNode
from us_sim.tracking.probe_arm import ProbeArm


class ProbeRobot(SceneNode):
    """``robot/twist`` and ``robot/wrench_reference`` in, ``tracker/pose`` out.

    It feels ``probe/wrench``. A command holds for `RobotSettings.timeout` after it came.

    Raises:
        SceneError: the scene has no robot.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("probe_robot", **kwargs)
        scene = self.scene
        if scene.robot is None:
            raise SceneError(
                f"{scene.origin}: `robot` is missing, so no arm holds the probe: add `robot: {{}}`"
            )
        self._robot, self._limit = scene.robot, scene.episode.force
        self._arm = ProbeArm(scene.robot, scene.episode)
        self._twist, self._wanted, self._felt = np.zeros(6), 0.0, 0.0
        self._came: dict[str, float] = {}  # s, monotonic, by command
        self._poses = self.stream(PoseStamped, LEAD_TOPIC)
        self.create_subscription(TwistStamped, "robot/twist", self._take_twist, FOREIGN)
        self.create_subscription(
            WrenchStamped, "robot/wrench_reference", self._take_reference, FOREIGN
        )
        self.listen(WrenchStamped, "probe/wrench", self._take_wrench)
        self.create_timer(1.0 / scene.robot.rate, self._tick)
        self.health.state = "holding"

    def _take_twist(self, message: TwistStamped) -> None:
        twist = twist_from(message)
        frame = message.header.frame_id
        if frame == "patient":
            turn = self._arm.pose.rotation.T
            twist = np.concatenate([turn @ twist[:3], turn @ twist[3:]])
        self._twist = twist
        self._came["twist"] = time.monotonic()

    def _take_reference(self, message: WrenchStamped) -> None:
        self._wanted = float(wrench_from(message, "probe")[2])
        self._came["force"] = time.monotonic()
        if not 0.0 <= self._wanted <= self._limit:
            self.health.problem(
                "force",
                f"robot/wrench_reference: {self._wanted:g} N along the axis is wanted, and the arm "
                f"presses with 0 to {self._limit:g} N (`episode.force`): the nearest is sought",
            )

    def _take_wrench(self, message: WrenchStamped) -> None:
        self._felt = -float(wrench_from(message, "probe")[2])
        self._came["wrench"] = time.monotonic()
        age = self.get_clock().now().nanoseconds - nanoseconds_of(message.header.stamp)
        self.health.values = {"force": f"{self._felt:.2f}", "force_age_ms": f"{1e-6 * age:.1f}"}

    def _tick(self) -> None:
        if "twist" in self._came and not self._is_fresh("twist"):
            del self._came["twist"]
            if self._twist.any():
                self.health.problem(
                    "command", f"no robot/twist for {self._robot.timeout:g} s: the probe is stopped"
                )
            self._twist = np.zeros(6)
        twist, wanted = self._twist, None
        if self._is_fresh("force"):
            wanted = self._wanted
            if not self._is_fresh("wrench"):
                wanted, twist = None, twist * [1, 1, 0, 1, 1, 1]
                self.health.problem(
                    "wrench", "no probe/wrench comes, so no force is sought: is there tissue?"
                )
        self.health.state = "following" if "twist" in self._came else "holding"
        if wanted is not None:
            self.health.state = "seeking a force"
        felt = self._felt if self._is_fresh("wrench") else 0.0
        pose = self._arm.move(twist, felt, wanted)
        self._poses.publish(pose_message(pose, self.get_clock().now().to_msg(), "patient"))
        self.health.published(LEAD_TOPIC)

    def _is_fresh(self, command: str) -> bool:
        return time.monotonic() - self._came.get(command, -np.inf) < self._robot.timeout


main = partial(run_node, ProbeRobot)


if __name__ == "__main__":
    sys.exit(main())
