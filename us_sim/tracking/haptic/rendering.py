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

__all__ = ["HapticRendering"]

_REMEMBERED = 4096
"""Poses of the handle kept for the models that carry their stamps."""

_BETWEEN = 20_000_000
"""ns: two poses nearer in time tell where the handle was between them."""

_RESTART = 1_000_000_000
"""ns: a stamp that jumps back by more is a restarted device, not a late pose."""

_LEVER = 0.05
"""m: a turn of the handle by an angle counts as a way of this much times it."""

_SMOOTHED = 5
"""Ticks over which the handle's way is averaged to tell the next one's."""

_RESERVE = 10
"""Ticks at the present speed for which there is energy left, below which less is given back."""

_STORED = 2.0
"""How much more energy than its model's the tissue may have stored: nothing beyond is given back,
so that what was lost on the way does not come back as a kick."""

_DAMPING = 10.0
"""N s/m, the most with which energy given away by mistake is taken back."""


class HapticRendering:
    """Evaluates the newest model of the contact at the newest pose, and gives no energy away.

    Each model is tied to the pose of the handle from which it was made, by its stamp, so it does
    not matter what the tracker did in between. From one model to the next what is felt goes on
    without a step. The work done by the wrench on the handle is added up (the passivity observer of
    B. Hannaford and J.-H. Ryu, Time-domain passivity control of haptic interfaces, IEEE Trans.
    Robotics and Automation 18, 2002); as soon as the handle would get more than it has given since
    contact began, the force along its way is taken off (their controller, for the next tick as in
    J.-H. Ryu, C. Preusche, B. Hannaford and G. Hirzinger, Time domain passivity control with
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
        self._not_before: int | None = None  # ns, that the next model's stamp must be after
        self._anchor = Pose()  # of the handle, when the model was made
        self._begun: int | None = None  # ns, when the ramp began
        self._left_over, self._since = np.zeros(6), 0  # of the models before, and from when on, ns
        self._felt = np.zeros(6)
        self._way = np.zeros(6)  # of the handle since the last tick
        self._ways: deque[NDArray[np.float64]] = deque(maxlen=_SMOOTHED)
        #: J, taken from the handle since contact began, less what it was given.
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
        """While the clutch is held nothing is felt."""
        self._is_clutched = held

    def distrust(self, why: str) -> None:
        """What came in cannot be used."""
        self._distrusted.append(why)

    def render(self, now: int) -> NDArray[np.float64]:
        """(6,) N, N m on the handle until the next tick, about its origin, axes of the arm.

        Args:
            now: ns, of the clock of `pose` and `model`.
        """
        doubt = self._take_poses(now)
        self.energy -= float(self._felt @ self._way)
        self._ways.append(self._way)
        if doubt:
            # Only what is found from here on is believed.
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
            most = max(_STORED * self._device.share * stored, 0.0) if wrench.any() else 0.0
            self.energy = min(self.energy, most)
        self._felt = self._passive(felt)
        return self._felt.copy()

    def _take_poses(self, now: int) -> str:
        """Take what arrived; a doubt about the handle, if any."""
        doubt = self._distrusted.popleft() if self._distrusted else ""
        self._way = np.zeros(6)
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
                way = _way(self._poses[-1], pose)
                far, turn = _lengths(way)
                if far > self._settings.jump:
                    doubt = f"the handle has jumped by {1e3 * far:.1f} mm"
                elif turn > self._settings.rotation_jump:
                    doubt = f"the handle has jumped by {math.degrees(turn):.0f}°"
                else:
                    self._way = self._way + way
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
        """Take the newest model, if it belongs to a pose; a doubt about what there is, if any."""
        if self._arrived_model:
            self._adopt(*self._arrived_model.popleft())
        if self._model is None:
            return "no model of the contact yet"
        if now - self._model_time > 1e9 * self._settings.model_timeout:
            return f"no model of the contact for {1e-6 * (now - self._model_time):.0f} ms"
        return ""

    def _adopt(self, model: ContactModel, time: int) -> None:
        """Go over to a newer model, if it is known where the handle was."""
        stamp = model.stamp - self._time_offset
        if self._not_before is not None and stamp <= self._not_before:
            return
        anchor = self._pose_at(stamp)
        if anchor is None:
            return
        before = self._model
        if before is not None and not self.doubt:
            # What is felt now goes over into the new model's.
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
        share = (stamp - first) / (second - first)
        return se3.interpolate(self._poses[place - 1], self._poses[place], share)

    def _far(self, moved: NDArray[np.float64]) -> str:
        """A doubt about a model made elsewhere, so far away (6,) m, rad."""
        far, turn = _lengths(moved)
        if far > self._settings.model_reach:
            return f"the probe is {1e3 * far:.1f} mm from where the contact is known"
        if turn > self._settings.model_rotation_reach:
            return f"the probe is turned {math.degrees(turn):.0f}° from where the contact is known"
        return ""

    def _doubted(self, doubt: str) -> NDArray[np.float64]:
        """Zero, and begin anew with the next model."""
        if not self.doubt:
            self.stopped = doubt
            self.stops += 1
        self.doubt = doubt
        self._begun = None
        self._model = None
        self._left_over, self._since = np.zeros(6), 0
        self._felt = np.zeros(6)
        self._ways.clear()
        self.energy = min(self.energy, 0.0)  # what was given away is still owed
        return np.zeros(6)

    def _left(self, now: int) -> NDArray[np.float64]:
        """(6,), what is still felt of the models before."""
        share = 1.0 - 1e-9 * (now - self._since) / self._settings.hand_over
        return self._left_over * min(max(share, 0.0), 1.0)

    def _unilateral(self, felt: NDArray[np.float64]) -> NDArray[np.float64]:
        """The wrench, less a force that would pull the handle against the tissue's push."""
        assert self._model is not None
        push = self._device.direction_on_handle(self._model.push)
        pulled = float(felt[:3] @ push)
        if pulled < 0.0:
            felt[:3] -= pulled * push
        return felt

    def _limited(self, felt: NDArray[np.float64]) -> NDArray[np.float64]:
        """At most what the arm may give."""
        force, torque = _lengths(felt)
        if force > self._settings.force_limit:
            felt[:3] *= self._settings.force_limit / force
        if torque > self._settings.torque_limit:
            felt[3:] *= self._settings.torque_limit / torque
        return felt

    def _passive(self, felt: NDArray[np.float64]) -> NDArray[np.float64]:
        """The wrench, less what along the handle's way would give more than there is."""
        way = sum(self._ways) / len(self._ways)
        given = float(felt @ way)
        left = self.energy
        allowed = left / _RESERVE if left > 0.0 else left
        if given <= allowed:
            return felt
        direction = way * self._metric
        square = float(direction @ direction)
        if square == 0.0:
            return felt
        # Along the way no more is taken off than is there, and than damping gives back.
        most = max(given, 0.0) + _DAMPING * self._settings.rate * square
        off = min(given - allowed, most) / square
        return self._limited(self._unilateral(felt - off * self._metric * direction))


def _way(first: Pose, second: Pose) -> NDArray[np.float64]:
    """(6,) m, rad, from one pose of the handle to another, along the axes of the arm."""
    turn = se3.rotation_between(first.orientation, second.orientation)
    return np.concatenate([second.position - first.position, turn])


def _lengths(pair: NDArray[np.float64]) -> tuple[float, float]:
    """Of the first and of the last three numbers."""
    a, b, c, d, e, f = pair.tolist()
    return math.sqrt(a * a + b * b + c * c), math.sqrt(d * d + e * e + f * f)
