"""The image with millimetres, outlines, colours and its age, for people."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.errors import SettingsError, UsSimError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import image_message
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.scene_node import SceneNode, explain_missing_poses
from us_sim.nodes.settings import AnnotatedImageSettings
from us_sim.nodes.streams.stream import FrameStream
from us_sim.scene.building import structure_colour
from us_sim.slicing.drawing.annotation import Annotation, Badge
from us_sim.slicing.drawing.label_outlines import snap_to_border
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import OVERLAYS

CHECKS = 5.0  # a second, of the age of the newest pose
_TOPIC = "ultrasound/image_annotated"
_AMBER, _RED, _GREY = (255, 176, 0), (235, 45, 45), (150, 150, 150)


class MessageAge:
    """The time since a message came, whatever its stamp: that may be of another clock.

    The age grows with the node's time, which stands while a bag is paused, but never faster than
    real time, since the node's may be set.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._came: tuple[int, int] | None = None  # ns of the node's time, and of real time

    def restart(self) -> None:
        """Count from now on."""
        self._came = int(self._node.get_clock().now().nanoseconds), time.monotonic_ns()

    @property
    def seconds(self) -> float | None:
        """The age, s; None before the first message."""
        if self._came is None:
            return None
        if self._node.get_clock().now().nanoseconds < self._came[0]:  # as when a bag starts again
            self.restart()
        ros, real = self._came
        now = self._node.get_clock().now().nanoseconds
        return 1e-9 * min(now - ros, time.monotonic_ns() - real)


class AnnotatedImage:
    """``ultrasound/image_annotated``: the image with outlines, scale and a badge.

    A picture is drawn for each image while somebody subscribes, with the colours of the stream
    that the parameter ``overlay`` chooses. If no pose comes for a while, the last image is sent
    again with a badge, under its own stamp; before the first pose a black one. In lockstep nothing
    ages. Its parameters are those of `AnnotatedImageSettings`.
    """

    def __init__(
        self,
        node: SceneNode,
        probe: Probe,
        label_names: Mapping[int, str],
        streams: Sequence[FrameStream] = (),
    ) -> None:
        self._node = node
        self._streams = streams
        by_topic = {each.topic: each for each in streams}
        self._overlays = {
            name: by_topic[mode.topic] for name, mode in OVERLAYS.items() if mode.topic in by_topic
        }
        self._live = LiveSettings(node, {"shown": AnnotatedImageSettings()}, self._require_overlay)
        self._require_overlay(self._live.values)
        numbers = {name: number for number, name in label_names.items()}
        self._structures = {
            numbers[given.label or name]: (name, structure_colour(node.scene, name))
            for name, given in node.scene.structures.items()
            if not given.file and (given.label or name) in numbers
        }
        self._publisher = node.create_stream_publisher(Image, _TOPIC)
        self._missing = False
        self._pose_age, self._image_age = MessageAge(node), MessageAge(node)
        self.change_probe(probe)
        if not node.lockstep:
            node.create_timer(1.0 / CHECKS, self._check)

    @property
    def is_wanted(self) -> bool:
        """True if somebody subscribes."""
        return bool(self._publisher.get_subscription_count() > 0)

    @property
    def state(self) -> str:
        """State of the probe's pose: ``waiting`` for the first, ``live``, ``stale`` or ``lost``."""
        age = self._pose_age.seconds
        if age is None:
            return "waiting"
        shown = self._live.values["shown"]
        if self._node.lockstep or age <= shown.stale_after:
            return "live"
        return "lost" if age > shown.lost_after else "stale"

    def change_probe(self, probe: Probe) -> None:
        """Annotate the images of another probe; those before are not shown again."""
        self._probe = probe
        is_flipped = self._live.values["shown"].flip
        self._annotation = Annotation(probe, self._structures, is_flipped=is_flipped)
        self._frame: Frame | None = None
        self._stamp = TimeMessage()  # zero: of a picture of no pose

    def on_usable_pose(self) -> None:
        """Count the pose's age anew, since a usable pose has come."""
        self._pose_age.restart()

    def publish_frame(self, frame: Frame, stamp: TimeMessage) -> None:
        """Keep the frame of the pose with that stamp, and send its picture if it is wanted."""
        if self.is_wanted:
            _ = frame.pixels  # if that fails, the frame before is kept
        self._frame, self._stamp = frame, stamp
        self._image_age.restart()
        if self.is_wanted:
            self._send(self._badge())

    def _check(self) -> None:
        """Send the last image again, marked, once it is old, or a black one."""
        self._report()
        badge = self._badge()
        if badge is not None and self.is_wanted:
            self._send(badge)

    def _report(self) -> None:
        node, state = self._node, self.state
        node.health.values["probe_pose"] = state
        missing = state in ("stale", "lost")
        why = explain_missing_poses(node) if missing else ""
        if missing and not self._missing and why:
            node.get_logger().info(f"{why}: the image is frozen until somebody does")
        elif missing and not self._missing:
            node.health.count_problem(
                "pose age",
                f"the newest probe pose is {self._pose_age.seconds:.1f} s old: the image is "
                f"frozen; look at the tracker",
            )
        elif self._missing and state == "live":
            node.get_logger().info("probe poses come again")
        self._missing = missing
        what = why or f"the probe's pose is {state}"
        node.health.warning = f"{what}: the image is frozen" if missing else ""

    def _badge(self) -> Badge | None:
        state, pose_age, image_age = self.state, self._pose_age.seconds, self._image_age.seconds
        if self._node.lockstep:
            return None
        if state == "waiting" or pose_age is None:
            return Badge("NO PROBE POSE", _GREY)
        if state == "lost":
            return Badge("LOST", _RED)
        if self._frame is None or image_age is None:
            return Badge("NO IMAGE YET", _GREY)
        age = max(pose_age, image_age)  # an image may be made again at an old pose
        if age <= self._live.values["shown"].stale_after:
            return None
        return Badge(f"STALE {age:.1f} s", _AMBER)

    def _send(self, badge: Badge | None) -> None:
        frame, shown = self._frame, self._live.values["shown"]
        labels, overlay = None, None
        if frame is None:
            image = np.zeros((self._probe.rows, self._probe.columns), np.uint8)
        else:
            image = frame.pixels
            labels = self._labels(frame)
            overlay = self._overlay(frame)
        if self._annotation.is_flipped != shown.flip:
            self._annotation = Annotation(self._probe, self._structures, is_flipped=shown.flip)
        lines = [line for each in self._streams if each.is_wanted for line in each.lines()]
        refine = None if frame is None else partial(snap_to_border, frame)
        picture = self._annotation.draw_annotated(image, labels, badge, overlay, lines, refine)
        if shown.beside:
            plain = image[:, ::-1] if shown.flip else image
            picture = np.hstack([np.repeat(plain[:, :, None], 3, axis=2), picture])
        self._publisher.publish(image_message(picture, self._stamp, "probe"))
        self._node.health.count_published(_TOPIC)

    def _labels(self, frame: Frame) -> NDArray[np.uint8] | None:
        try:
            return frame.labels if self._structures else None
        except UsSimError as error:
            self._node.health.count_problem("labels", f"{error}; nothing is outlined")
            return None

    def _overlay(self, frame: Frame) -> Overlay | None:
        stream = self._overlays.get(self._live.values["shown"].overlay)
        try:
            return stream.overlay(frame) if stream else None
        except UsSimError as error:
            self._node.health.count_problem(
                "overlay", f"{error}; no colours are laid over the image"
            )
            return None

    def _require_overlay(self, wanted: Mapping[str, AnnotatedImageSettings]) -> None:
        """Refuse colours that this scene cannot provide."""
        name = wanted["shown"].overlay
        if name not in ("none", *self._overlays):
            there = ", ".join(["none", *self._overlays])
            raise SettingsError(
                f"overlay: {self._node.scene.name} has nothing for {name!r}; it has {there}"
            )
