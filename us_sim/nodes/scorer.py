"""Says what the hand has done so far: metrics of the scan, and the steps of an exercise."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from us_sim.geometry.pose import Pose
from us_sim.nodes.messages import nanoseconds_of, pixels_from, pose_from, wrench_from
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import run_node
from us_sim.nodes.qos import EVERY, LATCHED, overridable
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import ScorerSettings
from us_sim.scene.building import scanner_of, volume_of
from us_sim.scoring.exercise import read_exercise
from us_sim.scoring.lumen import LiveScan
from us_sim.scoring.metrics import metrics_of
from us_sim.scoring.settings import ScoreSettings

_PERIOD = 200_000_000  # ns of the probe's poses, after which areas are measured again
_REMEMBERED = 256  # poses, for the image with the same stamp


class Scorer(SceneNode):
    """``probe/pose``, ``probe/wrench`` and ``ultrasound/labels`` in, ``score`` once a second.

    The first status has the metrics as values; one of each step follows, OK when it is done, with
    what was seen of it. The service ``~/clear`` begins anew.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("scorer", **kwargs)
        name = declared(self, ScorerSettings()).exercise or self.scene.exercise
        self._exercise = read_exercise(name) if name else None
        self._limits = declared(self, ScoreSettings())
        volume = volume_of(self.scene)
        self._live = LiveScan(volume, scanner_of(self.scene, volume, threads=self.threads))
        if self._exercise is not None:
            self._exercise.require(self._live.lines)
        self._poses: dict[int, Pose] = {}
        self._begin = self._measured = 0  # ns
        self._score = self.create_publisher(
            DiagnosticArray, "score", LATCHED, qos_overriding_options=overridable()
        )
        self.listen(PoseStamped, "probe/pose", self._take_pose, EVERY)
        self.listen(WrenchStamped, "probe/wrench", self._take_wrench, EVERY)
        if self._live.lines:
            self.newest(Image, "ultrasound/labels", self._take_labels)
        self.create_service(Trigger, "~/clear", self._clear)
        self.create_timer(1.0, self._tell)
        self.health.state = "following"

    def _take_pose(self, message: PoseStamped) -> None:
        stamp, pose = nanoseconds_of(message.header.stamp), pose_from(message, "patient")
        self._begin = self._begin or stamp
        self._live.add_pose(self._seconds(stamp), pose)
        self._poses[stamp] = pose
        if len(self._poses) > _REMEMBERED:
            del self._poses[next(iter(self._poses))]

    def _take_wrench(self, message: WrenchStamped) -> None:
        if self._begin:
            time = self._seconds(nanoseconds_of(message.header.stamp))
            self._live.add_force(time, wrench_from(message)[:3])

    def _take_labels(self, message: Image) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        pose = self._poses.get(stamp)
        if pose is not None and abs(stamp - self._measured) >= _PERIOD:
            self._measured = stamp
            self._live.add_labels(self._seconds(stamp), pose, pixels_from(message))

    def _seconds(self, stamp: int) -> float:
        return 1e-9 * (stamp - self._begin)

    def _tell(self) -> None:
        scan = self._live.scan()
        if scan is None or not self._score.get_subscription_count():
            return
        exercise = self._exercise
        steps = exercise.steps(scan) if exercise is not None else []
        metrics = metrics_of(scan, self._limits)
        told = DiagnosticStatus(
            level=DiagnosticStatus.OK,
            name=exercise.name if exercise is not None else self.scene.name,
            message=exercise.description if exercise is not None else "",
            values=[KeyValue(key=each.label, value=each.text) for each in metrics],
        )
        message = DiagnosticArray(status=[told])
        message.header.stamp = self.get_clock().now().to_msg()
        for step in steps:
            level = DiagnosticStatus.OK if step.is_done else DiagnosticStatus.WARN
            where = step.target if step.target is not None else ()
            values = [KeyValue(key=k, value=f"{v:.4f}") for k, v in zip("xyz", where, strict=False)]
            message.status.append(
                DiagnosticStatus(level=level, name=step.what, message=step.seen, values=values)
            )
        self._score.publish(message)
        self.health.published("score")

    def _clear(self, _: Any, response: Any) -> Any:
        self._live.clear()
        self._poses, self._begin, self._measured = {}, 0, 0
        response.success, response.message = True, "the score begins anew"
        return response


main = partial(run_node, Scorer)


if __name__ == "__main__":
    sys.exit(main())
