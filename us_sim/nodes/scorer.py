"""Scoring of the hand while it scans: metrics of the scan, and the steps of an exercise."""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from io import BytesIO
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import parameter_value_to_python
from sensor_msgs.msg import CompressedImage, Image

from us_sim import __version__
from us_sim.errors import ScoreError
from us_sim.geometry.pose import Pose
from us_sim.nodes.guarded_node import keep_newest, status_message
from us_sim.nodes.parameters import LiveSettings, declare_settings
from us_sim.nodes.process import node_main
from us_sim.nodes.qos import EVERY
from us_sim.nodes.scene_node import LEAD_TOPIC, SceneNode
from us_sim.nodes.settings import VIEWER, ScorerSettings
from us_sim.recording.decoding import nanoseconds_of, pixels_from, pose_from, wrench_from
from us_sim.scene.building import build_scanner, load_volume
from us_sim.scoring.exercise import Step, read_exercise
from us_sim.scoring.live import LiveScan, Score
from us_sim.scoring.metrics import Scan
from us_sim.scoring.picture import draw_score
from us_sim.scoring.result import classify_attempt, select_plain_metrics
from us_sim.scoring.result_place import ResultPlace
from us_sim.scoring.settings import CONTACT_FORCE, ScoreSettings

_PERIOD = 200_000_000  # ns of the probe's poses, after which areas are measured again
OWN = "scorer"
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
_LEVELS = {"done": OK, "missed": ERROR, "to do": WARN}  # by states of steps
_REMEMBERED = 256  # poses, for the image with the same stamp
_OF_PROBE = ("probe/pose", "probe/wrench", "ultrasound/labels")
_UNNAMED = "_NODE_NAME_UNKNOWN_"  # of a node that has just appeared
_CHANGING = ("tissue_deformer", "skin_deformer", "slice_interpolator", "probe_tracker")
"""Nodes whose changed parameters are noted in the result."""


class Scorer(SceneNode):
    """``probe/pose``, ``probe/wrench`` and ``ultrasound/labels`` in, ``score`` once a second.

    The first status has all metrics as values. The others' kind is their ``hardware_id``: a
    ``step``, with what was seen and where it is to be done, OK when it is done, an ERROR when it
    was missed; a ``fault``; ``plain``, the metrics to read first and the state of the attempt; and
    ``about``, the circumstances. The service ``~/clear`` begins anew; ``~/draw`` publishes a
    picture on ``score/picture``. The end of the attempt does so, too, and writes the result.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("scorer", **kwargs)
        live = LiveSettings(self, {OWN: ScorerSettings()}, check=self._check_answers)
        self._live_settings, self._settings = live, live.values[OWN]
        name = self._settings.exercise or self.scene.exercise
        self._exercise = read_exercise(name) if name else None
        limits = declare_settings(self, ScoreSettings())
        if self._exercise is not None and hasattr(self._exercise.assigned, "force_limit"):
            limits = replace(limits, force_limit=self._exercise.assigned.force_limit)
        self._limits = limits
        volume = load_volume(self.scene)
        scanner = build_scanner(self.scene, volume, threads=self.threads)
        self._live = LiveScan(volume, scanner, self._exercise, limits)
        self._title = self._exercise.name if self._exercise is not None else self.scene.name
        results = self._settings.results
        self._place = ResultPlace(results) if results else None
        self._void = "the scorer was started again: begin anew" if self._settings.begun else ""
        self._is_known = False  # a result has shown the truth about this arm
        self._is_tissue_ready = self.scene.tissue is None
        self._changes = dict.fromkeys(self._settings.chosen, "")  # when, by what was set
        self._scene_checksum = self.scene.compute_checksum()
        self._own_nodes = {OWN, VIEWER, _UNNAMED, *(part.node for part in self.scene.list_parts())}
        self._begin_attempt()
        self._score = self.create_latched_publisher(DiagnosticArray, "score")
        self._picture = self.create_latched_publisher(CompressedImage, "score/picture")
        self._picture.publish(CompressedImage())  # a page may have one of an earlier node
        self.subscribe(PoseStamped, "probe/pose", self._on_pose, EVERY)
        self.subscribe(WrenchStamped, "probe/wrench", self._on_wrench, EVERY)
        if self._live.lines:
            self.subscribe(Image, "ultrasound/labels", self._on_labels, newest=True)
        self.subscribe(ParameterEvent, "/parameter_events", self._on_parameters, EVERY)
        self.create_command("clear", self._clear)
        self.create_command("draw", self._draw)
        self.create_timer(1.0, self._publish_score)
        self.health.state = "following"

    def destroy_node(self) -> None:
        """Write results that could not be written before, and that of the running attempt."""
        if self._place is not None:
            self._write(self._place.write_kept)
        self._keep_result(self._live.compute_score(), is_last=True)
        super().destroy_node()

    def _begin_attempt(self) -> None:
        self._is_kept = False  # its picture is drawn and its result written
        self._poses: dict[int, Pose] = {}
        self._begin = self._measured = 0  # ns
        self._changes = dict.fromkeys(self._changes, "before")
        self._movers: set[str] = set()  # nodes that publish poses
        self._others: set[str] = set()  # beside the scene's, on the topics of the probe
        self._begun = datetime.now().astimezone().isoformat(timespec="seconds")
        self.health.values = {}

    def _on_pose(self, message: PoseStamped) -> None:
        stamp, pose = nanoseconds_of(message.header.stamp), pose_from(message, "patient")
        self._begin = self._begin or stamp
        self._live.add_pose(self._seconds(stamp), pose)
        keep_newest(self._poses, stamp, pose, _REMEMBERED)

    def _on_wrench(self, message: WrenchStamped) -> None:
        self._is_tissue_ready = True
        if self._begin:
            time, force = self._seconds(nanoseconds_of(message.header.stamp)), wrench_from(message)
            self._live.add_force(time, force[:3])
            if "begun" not in self.health.values and np.linalg.norm(force[:3]) >= CONTACT_FORCE:
                self.health.values["begun"] = f"{1e-9 * self._begin:.3f}"  # by now it is lost

    def _on_labels(self, message: Image) -> None:
        stamp = nanoseconds_of(message.header.stamp)
        pose = self._poses.get(stamp)
        if pose is not None and abs(stamp - self._measured) >= _PERIOD:
            self._measured = stamp
            self._live.add_labels(self._seconds(stamp), pose, pixels_from(message))

    def _seconds(self, stamp: int) -> float:
        return 1e-9 * (stamp - self._begin)

    def _check_answers(self, values: Mapping[str, Any]) -> None:
        own: ScorerSettings = values[OWN]
        if any(own.answers) or own.thrombus:
            self._live.set_answers(own.answers, own.thrombus)

    def _on_parameters(self, message: ParameterEvent) -> None:
        """Note changes of the simulation during the attempt, such as of the method."""
        node = message.node.removeprefix(f"{self.get_namespace().rstrip('/')}/")
        if node not in _CHANGING:
            return
        for changed in message.changed_parameters:
            value = parameter_value_to_python(changed.value)
            at = self._seconds(nanoseconds_of(message.stamp))
            when = f"at {at:.0f} s" if self._begin else "before"
            self._changes[f"{node}.{changed.name} = {value}"] = when

    def _publish_score(self) -> None:
        if not self._is_tissue_ready:  # nobody can press yet
            self._live.clear()
            self._begin = 0
            return
        movers = self.get_publishers_info_by_topic(self.resolve_topic_name(LEAD_TOPIC))
        self._movers.update(each.node_name for each in movers)
        for topic in map(self.resolve_topic_name, _OF_PROBE):
            ends = self.get_publishers_info_by_topic(topic)
            ends += self.get_subscriptions_info_by_topic(topic)
            self._others.update(each.node_name for each in ends)
        is_wanted = self._score.get_subscription_count() > 0
        score = self._live.compute_score() if is_wanted or self._place is not None else None
        if score is None:
            return
        if is_wanted:
            self._score.publish(self._message(score))
            self.health.count_published("score")
        self._keep_result(score)

    def _message(self, score: Score) -> DiagnosticArray:
        result = self._result(score)
        about, metrics = result["description"], result["metrics"]
        statuses = [status_message(result["name"], about, metrics, result["scene"], OK)]
        for step in result["steps"]:
            places = {"target": json.dumps(step["target"])} if "target" in step else {}
            level = _LEVELS[step["state"]]
            statuses.append(status_message(step["what"], step["seen"], places, "step", level))
        for fault in result["faults"]:
            values = {"seconds": fault["seconds"]}
            statuses.append(status_message("fault", fault["what"], values, "fault", WARN))
        statuses.append(status_message("plain", result["state"], result["plain"], "plain", OK))
        statuses.append(status_message("about", "", result["about"], "about", OK))
        message = DiagnosticArray(status=statuses)
        message.header.stamp = self.get_clock().now().to_msg()
        return message

    def _result(self, score: Score) -> dict[str, Any]:
        """Make the document of `us_sim.scoring.result`."""
        exercise, tissue = self._exercise, self.scene.tissue
        about = {
            "student": self._settings.student,
            "begun": self._begun,
            "exercise": exercise.origin if exercise is not None else "",
            "checksum": exercise.checksum if exercise is not None else "",
            "feedback": exercise.feedback if exercise is not None else "live",
            "scene": self.scene.name,
            "volume": self.scene.volume.name,
            "method": tissue.solver if tissue is not None else "none",
            "scene checksum": self._scene_checksum,
            "moved by": ", ".join(sorted(self._movers - {_UNNAMED})),
            "others": ", ".join(sorted(self._others - self._own_nodes)),
            "changed": "; ".join(f"{what} {when}" for what, when in self._changes.items()),
            "arm": "known from an attempt before" if self._is_known else "",
            "us_sim": __version__,
        }
        metrics = [] if self._is_hidden(score) else score.metrics
        plain = select_plain_metrics(score, self._limits.force_limit)
        faults = [{"seconds": round(each.time, 1), "what": each.what} for each in score.faults]
        if self._void:
            faults.insert(0, {"seconds": 0.0, "what": self._void})
        return {
            "name": self._title,
            "description": exercise.description if exercise is not None else "",
            "scene": self.scene.name,
            "state": classify_attempt(score, self._void),
            "seconds": score.seconds,
            "about": about,
            "plain": {each.label: each.format(3) for each in plain},
            "steps": [step.to_document() for step in score.steps],
            "faults": faults,
            "metrics": {each.label: each.format() for each in metrics},
        }

    def _is_hidden(self, score: Score) -> bool:
        """Return whether the result would tell the truth before the learner has answered."""
        exercise = self._exercise
        return exercise is not None and exercise.feedback == "afterwards" and not score.has_ended

    def _keep_result(self, score: Score | None, *, is_last: bool = False) -> None:
        """Draw and write the result, once, if the attempt has ended or this is its last chance."""
        is_due = score is not None and (score.has_ended or (is_last and score.seconds is not None))
        if score is None or not is_due or self._is_kept or self._exercise is None:
            return
        self._is_kept = True
        scan = None if self._is_hidden(score) else self._live.build_scan()
        picture = self._draw_score(scan, score.steps) if scan is not None else b""
        if not is_last:
            self._publish_picture(picture)
        if self._place is not None:
            result = self._result(score)
            result["state"] = "not passed" if result["state"] == "running" else result["state"]
            self._write(partial(self._place.write, result, picture))

    def _write(self, write: Callable[[], Sequence[str]]) -> None:
        try:
            files = write()
        except ScoreError as error:
            self.health.warning = str(error)
            self.get_logger().error(str(error))
            return
        if files:
            self.get_logger().info(f"the result is in {', '.join(files)}")

    def _draw_score(self, scan: Scan, steps: Sequence[Step]) -> bytes:
        drawn = BytesIO()
        draw_score(drawn, self._title, scan, steps)
        return drawn.getvalue()

    def _publish_picture(self, picture: bytes) -> None:
        message = CompressedImage(format="png", data=array("B", picture))
        message.header.stamp = self.get_clock().now().to_msg()
        self._picture.publish(message)
        self.health.count_published("score/picture")

    def _draw(self) -> str:
        score, scan = self._live.compute_score(), self._live.build_scan()
        if score is None or scan is None:
            return "nothing was done yet"
        if self._is_hidden(score):
            return "the result is told once all is answered"
        self._publish_picture(self._draw_score(scan, score.steps))
        return ""

    def _clear(self) -> str:
        score = self._live.compute_score()
        self._keep_result(score, is_last=True)
        asks = self._exercise is not None and self._exercise.feedback == "afterwards"
        self._is_known |= asks and score is not None and score.has_ended
        self._live.clear()
        without = replace(self._settings, answers=(), thrombus="")
        self._live_settings.restore_settings({OWN: without})
        self._void = ""
        self._begin_attempt()
        self._picture.publish(CompressedImage())  # that of the former attempt goes
        return ""


main = node_main(Scorer, __name__)
