"""Rendering of the force on the probe on a haptic arm, between two solutions of the tissue."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from std_msgs.msg import Bool, Float64MultiArray

from us_sim.errors import SceneError, StampError, UsSimError
from us_sim.nodes.messages import contact_model_from, serialize_wrench
from us_sim.nodes.process import node_main
from us_sim.nodes.qos import FOREIGN
from us_sim.nodes.scene_node import SceneNode
from us_sim.recording.decoding import nanoseconds_of, pose_from
from us_sim.scene.building import build_haptic_rendering, source_settings

_MEASURED = 2000  # ticks, of which the jitter is measured
CHECKS = 5.0  # a second, of who listens


class PeriodicThread:
    """Calls ``work`` at absolute times one period apart; skips times that have passed.

    Args:
        rate: Hz.
        work: called with the time in ns of the monotonic clock; it must not raise.
    """

    def __init__(self, rate: float, work: Callable[[int], None]) -> None:
        self._period = round(1e9 / rate)
        self._work = work
        self._ending = threading.Event()
        self._late: deque[int] = deque(maxlen=_MEASURED)  # ns
        self.skipped = 0
        self._thread = threading.Thread(target=self._run, name="periodic", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End after the present tick."""
        self._ending.set()
        self._thread.join()

    @property
    def jitter(self) -> float:
        """99th percentile, s, of the deviation from one period between the last ticks."""
        late = np.array(self._late)
        return 1e-9 * float(np.percentile(np.abs(np.diff(late)), 99)) if len(late) > 1 else 0.0

    def _run(self) -> None:
        due = time.monotonic_ns()
        while not self._ending.is_set():
            due += self._period
            wait = due - time.monotonic_ns()
            if wait > 0:
                time.sleep(1e-9 * wait)
            elif wait < -self._period:
                passed = -wait // self._period
                self.skipped += passed
                due += passed * self._period
            self._work(time.monotonic_ns())
            self._late.append(time.monotonic_ns() - due)


class HapticRenderer(SceneNode):
    """``haptic/pose``, ``haptic/clutch`` and ``tissue/contact_model`` in; ``haptic/wrench`` out.

    The wrench on the handle is published at ``tracker.haptic.rate``, about the handle's origin in
    the axes of the pose's frame, with the newest pose's stamp. It is zero at any doubt, which
    diagnostics explain, and grows slowly afterwards and for the first subscriber.
    """

    live_priority = 20  # its thread goes before other nodes; interrupts' are at 50

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("haptic_renderer", **kwargs)
        if self.scene.tissue is None:
            raise SceneError(f"{self.scene.origin}: tissue: is missing, so nothing can be felt")
        settings = source_settings(self.scene, "haptic")
        self._rendering = build_haptic_rendering(self.scene)
        self._frame = self.scene.tracker.frame
        self._has_subscriber = False
        self._stops = 0
        self._wrenches = self.create_stream_publisher(WrenchStamped, "haptic/wrench")
        self.subscribe(PoseStamped, "haptic/pose", self._on_pose, FOREIGN)
        self.subscribe(Bool, "haptic/clutch", lambda m: self._rendering.set_clutch(m.data), FOREIGN)
        self.subscribe(Float64MultiArray, "tissue/contact_model", self._on_model)
        self.health.measure = self._measure  # once a report: the jitter takes two ticks
        self._check_model_age()
        self.create_timer(1.0 / CHECKS, self._check_model_age)
        self._thread = PeriodicThread(settings.rate, self.guard_callback("rendering", self._render))

    def destroy_node(self) -> None:
        """Stop the thread and publish a zero wrench."""
        self._thread.stop()
        self._publish(np.zeros(6))
        super().destroy_node()

    def _on_pose(self, message: PoseStamped) -> None:
        pose, stamp = pose_from(message, self._frame), nanoseconds_of(message.header.stamp)
        if stamp == 0:
            raise StampError("there is no stamp: let the arm's driver set it")
        self._rendering.update_pose(stamp, pose, time.monotonic_ns())

    def _on_model(self, message: Float64MultiArray) -> None:
        self._rendering.update_model(contact_model_from(message), time.monotonic_ns())

    def report_bad_input(self, where: str, error: UsSimError) -> None:
        """Count and log input that cannot be used, and stop rendering."""
        super().report_bad_input(where, error)
        self._rendering.stop_rendering(f"{where}: {error}")

    def report_failure(self, where: str, error: Exception) -> None:
        """Count and log a failure, and begin anew, since the failed state may be corrupt."""
        super().report_failure(where, error)
        self._rendering = build_haptic_rendering(self.scene)
        self._stops = 0

    def _render(self, now: int) -> None:
        rendering = self._rendering
        if not self._has_subscriber:
            rendering.stop_rendering("nobody takes the wrench")
        wrench = np.zeros(6)
        try:
            wrench = rendering.render(now)
        finally:  # also if it fails: the arm must not keep its last wrench
            if self._has_subscriber:
                self._publish(wrench)

    def _publish(self, wrench: NDArray[np.float64]) -> None:
        newest = self._rendering.stamp
        stamp = self.get_clock().now().nanoseconds if newest is None else newest
        message = serialize_wrench(wrench, stamp, self._frame)
        try:
            self._wrenches.publish(message)
        except Exception:
            if self.context.ok():
                raise
            return  # rclpy was shut down meanwhile, as by a signal
        self.health.count_published("haptic/wrench")

    def _check_model_age(self) -> None:
        self._has_subscriber = self._wrenches.get_subscription_count() > 0
        doubt, stops = self._rendering.doubt, self._rendering.stops
        if stops > self._stops:
            self.health.count_problem("doubt", f"nothing is felt: {self._rendering.stopped}")
        self._stops = stops
        self.health.state = f"zero: {doubt}" if doubt else "rendering"

    def _measure(self) -> dict[str, str]:
        return {
            "stops": str(self._rendering.stops),
            "stopped": self._rendering.stopped,
            "jitter_p99_ms": f"{1e3 * self._thread.jitter:.3f}",
            "skipped": str(self._thread.skipped),
            "energy_mJ": f"{1e3 * self._rendering.energy:.3f}",
        }


main = node_main(HapticRenderer, __name__)
