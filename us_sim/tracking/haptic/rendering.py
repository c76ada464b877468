"""The wrench on a haptic arm's handle, a thousand times a second between the tissue's solutions.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.haptic.contact_model import ContactModel
>>> from us_sim.tracking.haptic.device import HapticDevice
>>> from us_sim.tracking.haptic.rendering import HapticRendering
>>> from us_sim.tracking.haptic.settings import HapticSettings
>>> settings = HapticSettings(ramp="10 ms", hand_over="5 ms")
>>> rendering = HapticRendering(settings, HapticDevice(settings))
>>> wrench, stiffness = np.zeros(6), np.diag([0.0, 0.0, 200.0, 0.0, 0.0, 0.0])
>>> for tick in range(100):  # down by 1 mm in 10 ms, into a wall of 200 N/m from z = 0 on
...     now, depth = tick * 1_000_000, tick * 1e-4
...     rendering.pose(now, Pose([0.0, 0.0, depth]), now)
...     wrench[2] = -200 * depth
...     rendering.model(ContactModel(now, Pose([0.0, 0.0, depth]), wrench, stiffness), now)
...     felt = rendering.render(now)
>>> float(felt[2].round(3)), rendering.doubt
(-1.98, '')
>>> rendering.render(now + 400_000_000), rendering.doubt
(array([0., 0., 0., 0., 0., 0.]), 'no pose of the handle for 400 ms')
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tracking.haptic.contact_model import ContactModel
from us_sim.tracking.haptic.device import HapticDevice
from us_sim.tracking.haptic.settings import HapticSettings

_REMEMBERED = 4096
"""Poses of the handle kept for the models that carry their stamps."""

_BETWEEN = 20_000_000
"""ns: between two poses nearer in time than this the handle's pose is interpolated."""

_RESTART = 1_000_000_000
"""ns: a stamp that jumps back by more is a restarted device, not a late pose."""

_LEVER = 0.05
"""m: a turn of the handle by an angle counts as a displacement of this lever times the angle."""

_SMOOTHED = 5
"""Ticks over which the handle's displacement is averaged to predict the next tick's."""

_RESERVE = 10
"""Ticks for which the energy left must last: one tick returns at most an equal part of it."""

_STORED = 2.0
"""Energy returned to the handle at most, over what the model says the tissue has stored, so that
energy that was lost meanwhile does not come back as a kick."""

_DAMPING = 10.0
"""N s/m, the strongest damping by which energy returned in excess is taken back."""


class HapticRendering:
    """Evaluates the newest model of the contact at the newest pose, and adds no energy.

    Each model is tied by its stamp to the pose of the handle from which it was made, so it does not
    matter what the tracker did in between. From one model to the next the wrench goes on without a
    step. The work done by the wrench on the handle is added up (the passivity observer of B.
    Hannaford and J.-H. Ryu, Time-domain passivity control of haptic interfaces, IEEE Trans.
    Robotics and Automation 18, 2002); as soon as the handle would get more than it has put in since
    contact began, the force along its motion is taken off (their controller, for the next tick as
    in J.-H. Ryu, C. Preusche, B. Hannaford and G. Hirzinger, Time domain passivity control with
    reference energy following, IEEE Trans. Control Systems Technology 13, 2005).

    After any doubt the wrench is zero, until a model comes that is newer, and then grows slowly.

    `pose`, `model`, `clutch` and `distrust` may be called while another thread renders.

    Args:
        settings: limits and times.
        device: how the handle moves the probe.
        time_offset: s that the tracker adds to the device's stamps.
    """

    def __init__(
        self, settings: HapticSettings, device: HapticDevice, *, time_offset: float = 0.0
    ) -> None:
        self._settings, self._device = settings, device
        self._time_offset = round(1e9 * time_offset)
        self._metric = np.array([1.0, 1.0, 1.0, _LEVER, _LEVER, _LEVER])
        self._arrived: deque[tuple[int, Pose, int]] = deque(maxlen=_REMEMBERED)
        self._arrived_model: deque[tuple[ContactModel, int]] = deque(maxlen=1)
        self._distrusted: deque[str] = deque(maxlen=1)
        self._is_clutched = False
        self._stamps: list[int] = []
        self._poses: list[Pose] = []
        self._pose_time: int | None = None
        self._model: ContactModel | None = None
        self._model_time = 0
        self._not_before: int | None = None  # ns, the next model's stamp must be later
        self._anchor = Pose()  # of the handle, when the model was made
        self._begun: int | None = None  # ns, when the ramp began
        self._left_over, self._since = (
            np.zeros(6),
            0,
        )  # wrench of earlier models, and since when, ns
        self._felt = np.zeros(6)
        self._motion = np.zeros(6)  # m, rad, of the handle since the last tick
        self._motions: deque[NDArray[np.float64]] = deque(maxlen=_SMOOTHED)
        #: J, work done by the handle since contact began, less work done on it.
        self.energy = 0.0
        #: Why nothing is felt; '' while something may be.
        self.doubt = "no pose of the handle yet"
        #: How often a doubt has ended what was felt, and the last that did.
        self.stops, self.stopped = 0, ""
        self._doubted(self.doubt)

    @property
    def stamp(self) -> int | None:
        """ns, of the newest pose of the handle."""
        return self._stamps[-1] if self._stamps else None

    def pose(self, stamp: int, pose: Pose, now: int) -> None:
        """Take a pose of the handle in the arm's frame; stamp and time of arrival in ns."""
        self._arrived.append((stamp, pose, now))

    def model(self, model: ContactModel, now: int) -> None:
        """Take a model of the contact; time of arrival in ns."""
        self._arrived_model.append((model, now))

    def clutch(self, held: bool) -> None:
        """Take the state of the clutch: while it is held nothing is felt."""
        self._is_clutched = held

    def distrust(self, why: str) -> None:
        """Stop, for a reason, because input cannot be used."""
        self._distrusted.append(why)

    def render(self, now: int) -> NDArray[np.float64]:
        """(6,) N, N m on the handle until the next tick, about its origin, axes of the arm.

        Args:
            now: ns, of the clock of `pose` and `model`.
        """
        doubt = self._take_poses(now)
        self.energy -= float(self._felt @ self._motion)
        self._motions.append(self._motion)
        if doubt:
            # Only models of poses from here on are believed.
            self._not_before = self._stamps[-1] if self._stamps else None
            return self._doubted(doubt)
        doubt = self._take_model(now)
        if doubt:
            return self._doubted(doubt)
        assert self._model is not None
        moved = self._device.probe_moved(self._model.pose, self._anchor, self._poses[-1])
        doubt = self._far(moved)
        if doubt:
            return self._doubted(doubt)
        self.doubt = ""
        if self._begun is None:
            self._begun = now
        stored, wrench = self._model.answer(moved)
        wrench += self._left(now)
        felt = self._device.on_handle(self._model.pose, moved[3:], wrench)
        felt = self._limited(self._unilateral(felt))
        felt *= min(1e-9 * (now - self._begun) / self._settings.ramp, 1.0)
        if self.energy > 0.0:
            most = max(_STORED * self._device.work_ratio * stored, 0.0) if wrench.any() else 0.0
            self.energy = min(self.energy, most)
        self._felt = self._passive(felt)
        return self._felt.copy()

    def _take_poses(self, now: int) -> str:
        """Take the poses that arrived; returns a doubt about the handle, or an empty text."""
        doubt = self._distrusted.popleft() if self._distrusted else ""
        self._motion = np.zeros(6)
        while self._arrived:
            stamp, pose, time = self._arrived.popleft()
            step = stamp - self._stamps[-1] if self._stamps else 1
            if step <= -_RESTART:
                self._stamps.clear()
                self._poses.clear()
                doubt = "the stamps of the handle's poses have jumped back"
            elif step <= 0:
                continue  # repeated or late: the handle is where the newest says
            if self._poses:
                motion = _motion(self._poses[-1], pose)
                distance, turn = _lengths(motion)
                if distance > self._settings.jump:
                    doubt = f"the handle has jumped by {1e3 * distance:.1f} mm"
                elif turn > self._settings.rotation_jump:
                    doubt = f"the handle has jumped by {math.degrees(turn):.0f}°"
                else:
                    self._motion = self._motion + motion
            self._stamps.append(stamp)
            self._poses.append(pose)
            self._pose_time = time
        if len(self._stamps) > 2 * _REMEMBERED:
            del self._stamps[:-_REMEMBERED], self._poses[:-_REMEMBERED]
        if doubt:
            return doubt
        if self._pose_time is None:
            return "no pose of the handle yet"
        if now - self._pose_time > 1e9 * self._settings.pose_timeout:
            return f"no pose of the handle for {1e-6 * (now - self._pose_time):.0f} ms"
        return "the clutch is held" if self._is_clutched else ""

    def _take_model(self, now: int) -> str:
        """Take the newest model if it belongs to a pose; returns a doubt, or an empty text."""
        if self._arrived_model:
            self._adopt(*self._arrived_model.popleft())
        if self._model is None:
            return "no model of the contact yet"
        if now - self._model_time > 1e9 * self._settings.model_timeout:
            return f"no model of the contact for {1e-6 * (now - self._model_time):.0f} ms"
        return ""

    def _adopt(self, model: ContactModel, time: int) -> None:
        """Change to a newer model, if it is known where the handle was."""
        stamp = model.stamp - self._time_offset
        if self._not_before is not None and stamp <= self._not_before:
            return
        anchor = self._pose_at(stamp)
        if anchor is None:
            return
        before = self._model
        if before is not None and not self.doubt:
            # The wrench felt now fades into the new model's.
            handle = self._poses[-1]
            _, old = before.answer(self._device.probe_moved(before.pose, self._anchor, handle))
            _, new = model.answer(self._device.probe_moved(model.pose, anchor, handle))
            self._left_over = old + self._left(time) - new
            self._since = time
        self._model, self._anchor, self._model_time = model, anchor, time
        self._not_before = stamp

    def _pose_at(self, stamp: int) -> Pose | None:
        """Where the handle was, or None where that is not known."""
        place = bisect_left(self._stamps, stamp)
        if place == len(self._stamps):
            return None
        if self._stamps[place] == stamp:
            return self._poses[place]
        if place == 0 or self._stamps[place] - self._stamps[place - 1] > _BETWEEN:
            return None
        first, second = self._stamps[place - 1], self._stamps[place]
        fraction = (stamp - first) / (second - first)
        return se3.interpolate(self._poses[place - 1], self._poses[place], fraction)

    def _far(self, moved: NDArray[np.float64]) -> str:
        """A doubt about a model made at a displacement (6,) m, rad, or an empty text."""
        distance, turn = _lengths(moved)
        if distance > self._settings.model_reach:
            return f"the probe is {1e3 * distance:.1f} mm from where the contact is known"
        if turn > self._settings.model_rotation_reach:
            return f"the probe is turned {math.degrees(turn):.0f}° from where the contact is known"
        return ""

    def _doubted(self, doubt: str) -> NDArray[np.float64]:
        """Return a wrench of zero, and begin anew with the next model."""
        if not self.doubt:
            self.stopped = doubt
            self.stops += 1
        self.doubt = doubt
        self._begun = None
        self._model = None
        self._left_over, self._since = np.zeros(6), 0
        self._felt = np.zeros(6)
        self._motions.clear()
        self.energy = min(self.energy, 0.0)  # energy returned in excess is still owed
        return np.zeros(6)

    def _left(self, now: int) -> NDArray[np.float64]:
        """(6,) N, N m, what is still felt of earlier models."""
        fraction = 1.0 - 1e-9 * (now - self._since) / self._settings.hand_over
        return self._left_over * min(max(fraction, 0.0), 1.0)

    def _unilateral(self, felt: NDArray[np.float64]) -> NDArray[np.float64]:
        """The wrench, less a force that would pull the handle against the tissue's push."""
        assert self._model is not None
        push = self._device.direction_on_handle(self._model.push)
        pulled = float(felt[:3] @ push)
        if pulled < 0.0:
            felt[:3] -= pulled * push
        return felt

    def _limited(self, felt: NDArray[np.float64]) -> NDArray[np.float64]:
        """The wrench within the limits of the arm."""
        force, torque = _lengths(felt)
        if force > self._settings.force_limit:
            felt[:3] *= self._settings.force_limit / force
        if torque > self._settings.torque_limit:
            felt[3:] *= self._settings.torque_limit / torque
        return felt

    def _passive(self, felt: NDArray[np.float64]) -> NDArray[np.float64]:
        """The wrench, less the part along the motion that would return too much energy."""
        motion = sum(self._motions) / len(self._motions)
        work = float(felt @ motion)
        left = self.energy
        allowed = left / _RESERVE if left > 0.0 else left
        if work <= allowed:
            return felt
        direction = motion * self._metric
        square = float(direction @ direction)
        if square == 0.0:
            return felt
        # No more is taken off along the motion than there is, and than the damping allows.
        most = max(work, 0.0) + _DAMPING * self._settings.rate * square
        off = min(work - allowed, most) / square
        return self._limited(self._unilateral(felt - off * self._metric * direction))


def _motion(first: Pose, second: Pose) -> NDArray[np.float64]:
    """(6,) m, rad, from one pose of the handle to another, along the axes of the arm."""
    turn = se3.rotation_between(first.orientation, second.orientation)
    return np.concatenate([second.position - first.position, turn])


def _lengths(pair: NDArray[np.float64]) -> tuple[float, float]:
    """The norms of the first and of the last three numbers."""
    a, b, c, d, e, f = pair.tolist()
    return math.sqrt(a * a + b * b + c * c), math.sqrt(d * d + e * e + f * f)
