"""Says what the hand has done so far: metrics of the scan, and the steps of an exercise."""

from __future__ import annotations

import json
from array import array
from collections.abc import Sequence
from io import BytesIO
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import CompressedImage, Image

from us_sim.geometry.pose import Pose
from us_sim.nodes.parameters import declared
from us_sim.nodes.process import node_main
from us_sim.nodes.qos import EVERY
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import ScorerSettings
from us_sim.recording.decoding import nanoseconds_of, pixels_from, pose_from, wrench_from
from us_sim.scene.building import scanner_of, volume_of
from us_sim.scoring.exercise import Step, read_exercise
from us_sim.scoring.live import LiveScan
from us_sim.scoring.picture import draw_score
from us_sim.scoring.settings import ScoreSettings

_PERIOD = 200_000_000  # ns of the probe's poses, after which areas are measured again
_REMEMBERED = 256  # poses, for the image with the same stamp


class Scorer(SceneNode):
    """``probe/pose``, ``probe/wrench`` and ``ultrasound/labels`` in, ``score`` once a second.

    The first status has the metrics as values; one of each step follows, with what was seen of it
    and where it is to be done. It is OK when it is done, and an ERROR when it was missed.
    The service ``~/clear`` begins anew; ``~/draw`` has a picture made, on ``score/picture``, which
    is also made once the last step is done.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("scorer", **kwargs)
        name = declared(self, ScorerSettings()).exercise or self.scene.exercise
        self._exercise = read_exercise(name) if name else None
        limits = declared(self, ScoreSettings())
        volume = volume_of(self.scene)
        scanner = scanner_of(self.scene, volume, threads=self.threads)
        self._live = LiveScan(volume, scanner, self._exercise, limits)
        self._title = self._exercise.name if self._exercise is not None else self.scene.name
        self._is_drawn = False  # since the last step was done
        self._poses: dict[int, Pose] = {}
        self._begin = self._measured = 0  # ns
        self._score = self.latched(DiagnosticArray, "score")
        self._picture = self.latched(CompressedImage, "score/picture")
        self._picture.publish(CompressedImage())  # what a page has may be of a node before
        self.subscribe(PoseStamped, "probe/pose", self._on_pose, EVERY)
        self.subscribe(WrenchStamped, "probe/wrench", self._on_wrench, EVERY)
        if self._live.lines:
            self.subscribe(Image, "ultrasound/labels", self._on_labels, newest=True)
        self.offer("clear", self._clear)
        self.offer("draw", self._draw)
        self.create_timer(1.0, self._tell)
        self.health.state = "following"

    def _on_pose(self, message: PoseStamped) -> None:
        stamp, pose = nanoseconds_of(message.header.stamp), pose_from(message, "patient")
        self._begin = self._begin or stamp
        self._live.add_pose(self._seconds(stamp), pose)
        self._poses[stamp] = pose
        if len(self._poses) > _REMEMBERED:
            del self._poses[next(iter(self._poses))]

    def _on_wrench(self, message: WrenchStamped) -> None:
        if self._begin:
            time = self._seconds(nanoseconds_of(message.header.stamp))
            self._live.add_force(time, wrench_from(message)[:3])

    def _on_labels(self, message: Image) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        pose = self._poses.get(stamp)
        if pose is not None and abs(stamp - self._measured) >= _PERIOD:
            self._measured = stamp
            self._live.add_labels(self._seconds(stamp), pose, pixels_from(message))

    def _seconds(self, stamp: int) -> float:
        return 1e-9 * (stamp - self._begin)

    def _tell(self) -> None:
        if not self._score.get_subscription_count():
            return
        score = self._live.score()
        if score is None:
            return
        metrics, steps = score
        told = DiagnosticStatus(
            level=DiagnosticStatus.OK,
            name=self._title,
            message=self._exercise.description if self._exercise is not None else "",
            hardware_id=self.scene.name,
            values=[KeyValue(key=each.label, value=each.text) for each in metrics],
        )
        message = DiagnosticArray(status=[told, *map(_status_of, steps)])
        message.header.stamp = self.get_clock().now().to_msg()
        self._score.publish(message)
        self.health.published("score")
        is_passed = bool(steps) and all(step.is_done for step in steps)
        if is_passed and not self._is_drawn and self._picture.get_subscription_count():
            self._is_drawn = self._publish_picture(steps)

    def _publish_picture(self, steps: Sequence[Step]) -> bool:
        """Publish a picture of the scan; whether there is one."""
        scan = self._live.scan()
        if scan is None:
            return False
        drawn = BytesIO()
        draw_score(drawn, self._title, scan, steps)
        message = CompressedImage(format="png", data=array("B", drawn.getvalue()))
        message.header.stamp = self.get_clock().now().to_msg()
        self._picture.publish(message)
        self.health.published("score/picture")
        return True

    def _draw(self) -> str:
        score = self._live.score()
        is_drawn = score is not None and self._publish_picture(score[1])
        return "" if is_drawn else "nothing was done yet"

    def _clear(self) -> str:
        self._live.clear()
        self._poses, self._begin, self._measured = {}, 0, 0
        self._is_drawn = False
        self._picture.publish(CompressedImage())  # what was drawn is of before
        return ""


def _status_of(step: Step) -> DiagnosticStatus:
    level = DiagnosticStatus.ERROR if step.is_missed else DiagnosticStatus.WARN
    values = []
    if step.target is not None:
        values.append(KeyValue(key="target", value=json.dumps(step.target.round(4).tolist())))
    if step.pose is not None:
        pose = [*step.pose.position.tolist(), *step.pose.orientation.tolist()]
        values.append(KeyValue(key="pose", value=json.dumps(pose)))
    return DiagnosticStatus(
        level=DiagnosticStatus.OK if step.is_done else level,
        name=step.what,
        message=step.seen,
        values=values,
    )


main = node_main(Scorer, __name__)
