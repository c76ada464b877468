"""Tracking of the probe by a device's measurements, and the state of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from visualization_msgs.msg import MarkerArray

from us_sim.geometry.transducer import build_transducer_mesh
from us_sim.nodes.guarded_node import status_message
from us_sim.nodes.messages import (
    MarkerShape,
    TFMessage,
    pose_message,
    pose_text,
    serialize_markers,
    stamp_message,
    transform_message,
)
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.process import node_main
from us_sim.nodes.scene_node import explain_missing_poses
from us_sim.nodes.settings import ProbeTrackerSettings
from us_sim.nodes.tracker_inputs.device import TrackerInput, TrackerNode
from us_sim.scene.building import (
    build_collider,
    build_probe,
    build_tracking,
    load_tracker_poses,
    source_settings,
)
from us_sim.settings.registry import FILTERS, TRACKERS
from us_sim.slicing.probe.probe import compute_image_outline
from us_sim.tracking.filters import PoseFilter, create_filter
from us_sim.tracking.measurement import PATIENT, Measurement, TrackingState

OWN = "probe_tracker"
FARTHEST = 100.0  # m from the device's origin, beyond which a pose is in another unit, or nonsense
OUTLINE, LINE_WIDTH = (0.31, 0.70, 0.75, 1.0), 4e-4  # colour and m, of the image in the marker
CHECKS = 20.0  # a second, of the state when nothing comes
LEVELS = {
    TrackingState.WAITING: DiagnosticStatus.STALE,
    TrackingState.TRACKED: DiagnosticStatus.OK,
    TrackingState.COASTING: DiagnosticStatus.WARN,
    TrackingState.LOST: DiagnosticStatus.ERROR,
}


class ProbeTracker(TrackerNode):
    """A source's measurements in; ``probe/pose``, ``tf``, ``tf_static`` and ``probe/status`` out.

    The source is ``tracker.source`` of the scene, or the parameter ``source``, see
    `tracker_inputs`. A pose is published once, with the stamp of its measurement.
    ``probe/status``, latched, is ``tracked``, ``coasting`` or ``lost``, the latter two with the
    last pose. ``probe/marker``, latched, is the transducer to look at. ``tf_static`` has the
    device's own frame in ``patient``, unless tf is the source: a driver's tree may hold it. Both
    need ``tf2_msgs``. The filter and its settings may change while running.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("probe_tracker", **kwargs)
        chosen = self.scene.tracker.filter
        given: dict[str, Any] = {f"{name}.": FILTERS.load_settings(name)() for name in FILTERS}
        if chosen.given:
            given[f"{chosen.name}."] = chosen.given
        own = ProbeTrackerSettings(filter=chosen.name)
        live = LiveSettings(self, {OWN: own, **given}, use=self._apply_settings)
        self._source = live.values[OWN].source or self.scene.tracker.source.name
        self._tracking = build_tracking(self.scene, _filter(live.values))
        self._state = TrackingState.WAITING
        self._taken_at = 0  # ns, when the last measurement was taken
        self._last: Measurement | None = None  # that was published
        self._poses = self.create_stream_publisher(PoseStamped, "probe/pose")
        self._transforms = None
        if TFMessage is not None:
            self._transforms = self.create_stream_publisher(TFMessage, "tf")
            self._publish_device_frame()
        self._status = self.create_latched_publisher(DiagnosticStatus, "probe/status")
        marker = self.create_latched_publisher(MarkerArray, "probe/marker")
        marker.publish(self._transducer_markers())
        settings = source_settings(self.scene, self._source)
        self._input: TrackerInput = TRACKERS.load(self._source)(self, settings)
        self.health.state = "waiting for poses"
        self._publish_status()
        if not self.lockstep:
            self.create_timer(1.0 / CHECKS, self._check)

    def _publish_device_frame(self) -> None:
        device = self.scene.tracker.frame
        if self._source != "tf" and device != PATIENT:
            place, _ = load_tracker_poses(self.scene)
            placed = transform_message(place, TimeMessage(), PATIENT, device)
            publisher = self.create_latched_publisher(TFMessage, "tf_static")
            publisher.publish(TFMessage(transforms=[placed]))

    def _transducer_markers(self) -> bytes:
        """Make markers of the image's outline and, if the scene has a collider, the transducer."""
        section = self.scene.probe.collider
        parts = build_transducer_mesh(build_collider(self.scene)) if section is not None else []
        shapes = [
            MarkerShape(p.name, (*p.colour, 1.0), p.vertices[p.triangles.ravel()]) for p in parts
        ]
        outline = compute_image_outline(build_probe(self.scene))
        closed = np.concatenate([outline, outline[:1]])
        shapes.append(MarkerShape("image", OUTLINE, closed, LINE_WIDTH))
        return serialize_markers(shapes, TimeMessage(), "probe")

    def _apply_settings(self, values: dict[str, Any]) -> None:
        self._tracking.filter = _filter(values)

    def destroy_node(self) -> None:
        """Close the source."""
        if hasattr(self, "_input"):  # it may have refused to be made
            self._input.close()
        super().destroy_node()

    def take_measurement(self, measurement: Measurement) -> None:
        """Publish the probe's pose, unless the measurement is refused."""
        distance = float(abs(measurement.pose.position).max())
        if distance > FARTHEST:
            self.refuse_measurement(
                "far",
                f"the tracker's pose is {distance:.3g} m away, and no tracker sees beyond "
                f"{FARTHEST:g} m: positions are in metres; it is not used",
            )
            return
        now = self.read_clock()
        if now < self._taken_at:  # the clock was set back, as when a recording begins again
            self._tracking.reset()
        self._taken_at = now
        restarts = self._tracking.restarts.total()
        probe = self._tracking.process_measurement(measurement, now)
        if self._tracking.restarts.total() > restarts:
            self.get_logger().info(
                "the tracker's poses start anew, and so does the filter", throttle_duration_sec=5.0
            )
        if probe is None:
            problem = f"{self._tracking.last_problem}; it is not used"
            self.health.count_problem(self._tracking.last_refused, problem)
            self._check()
            return
        stamp = stamp_message(probe.stamp)
        self._last = probe
        self._poses.publish(pose_message(probe.pose, stamp, PATIENT))
        self.health.count_published("probe/pose", stamp)
        if self._transforms is not None and self._transforms.get_subscription_count():
            transform = transform_message(probe.pose, stamp, PATIENT, "probe")
            self._transforms.publish(TFMessage(transforms=[transform]))
            self.health.count_published("tf")
        deviation = probe.position_deviation
        self.health.values |= {
            "filter_lag_ms": f"{1e3 * self._tracking.filter.lag:.1f}",
            **({"fit_error": f"{probe.error:.3g}"} if probe.error is not None else {}),
            **({"deviation_mm": f"{1e3 * deviation:.3f}"} if deviation is not None else {}),
        }
        self._check()

    def _check(self) -> None:
        """Publish and log the state if it has changed."""
        state = self._tracking.find_state(self.read_clock())
        if state is self._state:
            return
        self.health.warning = self.health.fault = ""
        if state is TrackingState.LOST and (why := explain_missing_poses(self)):
            self.health.warning = why
            self.get_logger().info(f"{why}: the probe stays where it is")
        elif state is TrackingState.LOST:
            self.health.fault = "the probe is lost"
            self.get_logger().warning("the probe is lost: no pose of it can be used any more")
        elif state is TrackingState.TRACKED and self._state is not TrackingState.COASTING:
            self.get_logger().info("the probe is tracked")
        self._state = state
        self.health.state = "waiting for poses" if state is TrackingState.WAITING else state.value
        self._publish_status()

    def _publish_status(self) -> None:
        state, refused = self._state, self._tracking.refused
        values = {f"refused {kind}": str(count) for kind, count in refused.items()}
        if self._last is not None and state is not TrackingState.TRACKED:
            values |= {"pose": pose_text(self._last.pose), "stamp": str(self._last.stamp)}
        status = status_message("probe", state.value, values, self._source, LEVELS[state])
        self._status.publish(status)


def _filter(values: dict[str, Any]) -> PoseFilter:
    name = values[OWN].filter
    return create_filter(name, values[f"{name}."])


main = node_main(ProbeTracker, __name__)
