"""A robot arm that holds the probe: it follows a velocity and seeks a force."""

from __future__ import annotations

import time
from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped, WrenchStamped

from us_sim.errors import MessageError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import pose_message
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import MEASURING, node_main
from us_sim.nodes.qos import FOREIGN
from us_sim.nodes.scene_node import LEAD_TOPIC
from us_sim.recording.decoding import twist_from, wrench_from
from us_sim.tracking.robot import Robot, RobotSettings


class ProbeRobot(GuardedNode):
    """``robot/twist``, ``robot/force`` and ``probe/wrench`` in, ``tracker/pose`` out."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("probe_robot", **kwargs)
        self._settings = declare_settings(self, RobotSettings())
        self._robot = Robot(self._settings)
        self.realtime_priority = MEASURING  # it stands for a device
        self.health = Health(self, "robot arm")
        self.health.state = self._robot.action
        self._poses = self.create_stream_publisher(PoseStamped, LEAD_TOPIC)
        self.subscribe(TwistStamped, "robot/twist", self._on_twist, FOREIGN)
        self.subscribe(WrenchStamped, "robot/force", self._on_force, FOREIGN)
        self.subscribe(WrenchStamped, "probe/wrench", self._on_wrench)
        self.create_timer(1.0 / self._settings.rate, self._move)

    def _on_twist(self, message: TwistStamped) -> None:
        twist, frame = twist_from(message), message.header.frame_id
        if frame not in ("probe", "patient"):
            raise MessageError(f"is in frame '{frame}', neither 'probe' nor 'patient'")
        self._robot.request_velocity(time.monotonic(), twist, in_patient=frame == "patient")

    def _on_force(self, message: WrenchStamped) -> None:
        wanted, most = float(wrench_from(message, "probe")[2]), self._settings.force
        if not 0.0 <= wanted <= most:
            self.health.count_problem(
                "force", f"robot/force: {wanted:g} N is outside 0 to {most:g} N: the nearer is used"
            )
        self._robot.request_force(time.monotonic(), wanted)

    def _on_wrench(self, message: WrenchStamped) -> None:
        self._robot.update_force(time.monotonic(), -float(wrench_from(message, "probe")[2]))

    def _move(self) -> None:
        pose = self._robot.move_until(time.monotonic())
        self.health.state = self._robot.action
        self._poses.publish(pose_message(pose, self.get_clock().now().to_msg(), "patient"))
        self.health.count_published(LEAD_TOPIC)


main = node_main(ProbeRobot, __name__)
