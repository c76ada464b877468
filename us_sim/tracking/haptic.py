"""A haptic arm: its handle moves the probe, and feels the tissue a thousand times a second.

Between two solutions of the tissue the contact force is that of a model, an energy whose slope is
the wrench:

>>> from us_sim.tracking.haptic import ContactModel
>>> wrench = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])  # N: pressed 10 mm into 200 N/m
>>> stiffness = np.diag([0.0, 0.0, 200.0, 0.0, 0.0, 0.0])
>>> wall = ContactModel(0, Pose(position=[0.0, 0.0, 0.01]), wrench, stiffness)
>>> moved = [np.array([0.0, 0.0, z, 0.0, 0.0, 0.0]) for z in (0.005, -0.005, -0.015)]
>>> [round(float(wall.compute_wrench(each)[1][2]), 6) + 0.0 for each in moved]
[-3.0, -1.0, 0.0]
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry import se3
from us_sim.geometry.frame_chain import PoseHistory
from us_sim.geometry.pose import Pose, multiply_quaternions
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import HapticSettings

Array = NDArray[np.float64]

_FADING = 0.5  # fraction of the push at the model's pose below which the rest of the energy fades
_FARTHEST = 0.03  # m: distance after which the push ends at the latest, however soft the tissue is


def rotate_to_patient(pose: Pose, force: Array, torque: Array) -> Array:
    """Turn force and torque (3,) from the probe's axes to those of ``patient``: (6,) N, N m."""
    return np.concatenate([pose.rotation @ force, pose.rotation @ torque])


@dataclass(frozen=True, eq=False)
class ContactModel:
    """The wrench on the probe near a pose, from the tissue's last solution.

    With d the displacement of the probe's origin and its rotation vector about the axes of
    ``patient``, the energy is ``-wrench · d + d · stiffness d / 2``. The part of it along the push
    is that of a spring, which ends where it would pull. The rest is bounded by the energy of that
    spring, and fades with the push, so that it is zero without one. The wrench is the slope of
    this one energy: over a closed path no work is done.
    """

    stamp: int  # ns, of the pose
    pose: Pose  # of the probe in patient
    wrench: Array  # (6,) N, N m, on the probe, about its origin, axes of patient
    stiffness: Array  # (6, 6) N/m, N, N m, symmetric: how the wrench falls with the motion

    @property
    def push(self) -> Array:
        """(3,) unit direction in which the tissue pushes the probe; zero without contact."""
        return self._split[0]

    @cached_property
    def _split(self) -> tuple[Array, float, Array, Array, Array]:
        """The push's direction (3,), N and slope (6,); the rest's wrench (6,), stiffness (6, 6)."""
        force = float(np.linalg.norm(self.wrench[:3]))
        if force == 0.0:
            return np.zeros(3), 0.0, np.zeros(6), np.zeros(6), np.zeros((6, 6))
        direction = self.wrench[:3] / force
        along = np.concatenate([direction, np.zeros(3)])
        slope = self.stiffness @ along
        lacking = max(force / _FARTHEST - float(direction @ slope[:3]), 0.0)
        slope += lacking * along
        shape = slope / float(direction @ slope[:3])
        rest = self.stiffness + lacking * np.outer(along, along) - np.outer(slope, shape)
        return direction, force, slope, self.wrench - force * shape, rest

    def compute_wrench(self, displacement: Array) -> tuple[float, Array]:
        """Return the energy (J) and the wrench (6,) N, N m at a displacement (6,) m, rad."""
        energy, wrench = self._slope(displacement)
        turn = displacement[3:]
        if wrench[3:].any() and turn.any():
            # The energy falls along rotation vectors; a torque works on angular velocities.
            wrench[3:] = np.linalg.solve(se3.left_jacobian(turn).T, wrench[3:])
        return energy, wrench

    def _slope(self, d: Array) -> tuple[float, Array]:
        """Return the energy (J) at a displacement (6,), and its negative slope (6,)."""
        direction, force, slope, wrench, stiffness = self._split
        if force == 0.0:
            return 0.0, np.zeros(6)
        spring = float(direction @ slope[:3])
        push = force - float(slope @ d)
        if push <= 0.0:
            return 0.0, np.zeros(6)
        # The factor of the rest of the energy, and its slope with the push.
        x = min(push / force / _FADING, 1.0)
        fade, fade_slope = x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / _FADING
        pulled = wrench - stiffness @ d
        # At most what the spring along the push stored, or light contact would end with a kick.
        most = 0.5 * force * force / spring
        part = math.tanh(-0.5 * float((wrench + pulled) @ d) / most)
        rest = most * part
        energy = 0.5 * push * push / spring + fade * rest
        answer = (push / spring + fade_slope / force * rest) * slope
        answer += fade * (1.0 - part * part) * pulled
        return energy, answer


_QUEUED = 4096  # poses that wait for the next tick
_BETWEEN = 20_000_000  # ns: poses nearer in time than this are interpolated between
_RESTART = 1_000_000_000  # ns: a stamp that jumps back by more is a restarted device, not late
_LEVER = 0.05  # m: a turn by an angle counts as a displacement of this times the angle
_SMOOTHED = 5  # ticks over which the handle's displacement is averaged to predict the next tick's
_RESERVE = 10  # ticks for which the energy left must last: each returns at most an equal part
_STORED = 2.0
"""Energy returned to the handle at most, over what the model says the tissue has stored, so that
energy that was lost meanwhile does not come back as a kick."""

_JUMP, _ROTATION_JUMP = 0.01, 0.3  # m and rad: the handle moves no farther between two poses
_REACH, _ROTATION_REACH = 0.02, 0.5  # m and rad from a model's pose, beyond which it says nothing
_DAMPING = 10.0  # N s/m, the strongest damping by which energy returned in excess is taken back


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

    `update_pose`, `update_model`, `set_clutch` and `stop_rendering` may be called while another
    thread renders.

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
        self._arrived: deque[tuple[int, Pose, int]] = deque(maxlen=_QUEUED)
        self._arrived_model: deque[tuple[ContactModel, int]] = deque(maxlen=1)
        self._distrusted: deque[str] = deque(maxlen=1)
        self._is_clutched = False
        self._handle = PoseHistory(longest=_BETWEEN)
        self._pose_time: int | None = None
        self._model: ContactModel | None = None
        self._model_time = 0
        self._not_before: int | None = None  # ns, the next model's stamp must be later
        self._anchor = Pose()  # of the handle, when the model was made
        self._begun: int | None = None  # ns, when the ramp began
        self._left_over, self._since = np.zeros(6), 0  # wrench of earlier models, since when (ns)
        self._felt = np.zeros(6)
        self._motion = np.zeros(6)  # m, rad, of the handle since the last tick
        self._motions: deque[Array] = deque(maxlen=_SMOOTHED)
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
        return self._handle.stamps[-1] if self._handle.stamps else None

    def update_pose(self, stamp: int, pose: Pose, now: int) -> None:
        """Set the pose of the handle in the arm's frame; stamp and time of arrival in ns."""
        self._arrived.append((stamp, pose, now))

    def update_model(self, model: ContactModel, now: int) -> None:
        """Set the model of the contact; time of arrival in ns."""
        self._arrived_model.append((model, now))

    def set_clutch(self, held: bool) -> None:
        """Set the state of the clutch: while it is held nothing is felt."""
        self._is_clutched = held

    def stop_rendering(self, why: str) -> None:
        """Stop, for a reason, because input cannot be used."""
        self._distrusted.append(why)

    def render(self, now: int) -> Array:
        """Return the wrench (6,) N, N m on the handle until the next tick.

        It is about the handle's origin, along the axes of the arm. ``now`` is in ns of the clock of
        `update_pose` and `update_model`.
        """
        doubt = self._take_poses(now)
        self.energy -= float(self._felt @ self._motion)
        self._motions.append(self._motion)
        if doubt:
            # Only models of poses from here on are believed.
            self._not_before = self.stamp
            return self._doubted(doubt)
        if self._arrived_model:
            self._adopt(*self._arrived_model.popleft())
        if self._model is None:
            return self._doubted("no model of the contact yet")
        age = now - self._model_time
        if age > 1e9 * self._settings.model_timeout:
            return self._doubted(f"no model of the contact for {1e-6 * age:.0f} ms")
        moved = self._device.compute_probe_motion(
            self._model.pose, self._anchor, self._handle.poses[-1]
        )
        distance, turn = _lengths(moved)
        if distance > _REACH:
            return self._doubted(
                f"the probe is {1e3 * distance:.1f} mm from where the contact is known"
            )
        if turn > _ROTATION_REACH:
            return self._doubted(
                f"the probe is turned {math.degrees(turn):.0f}° from where the contact is known"
            )
        self.doubt = ""
        if self._begun is None:
            self._begun = now
        stored, wrench = self._model.compute_wrench(moved)
        wrench += self._left(now)
        felt = self._device.compute_handle_wrench(self._model.pose, moved[3:], wrench)
        felt = self._limited(self._unilateral(felt))
        felt *= min(1e-9 * (now - self._begun) / self._settings.ramp, 1.0)
        if self.energy > 0.0:
            most = max(_STORED * self._device.work_ratio * stored, 0.0) if wrench.any() else 0.0
            self.energy = min(self.energy, most)
        self._felt = self._passive(felt)
        return self._felt.copy()

    def _take_poses(self, now: int) -> str:
        """Use the poses that arrived; return a doubt about the handle, or ""."""
        doubt = self._distrusted.popleft() if self._distrusted else ""
        self._motion = np.zeros(6)
        while self._arrived:
            stamp, pose, time = self._arrived.popleft()
            step = 1 if self.stamp is None else stamp - self.stamp
            if step <= -_RESTART:
                self._handle.clear()
                doubt = "the stamps of the handle's poses have jumped back"
            elif step <= 0:
                continue  # repeated or late: the handle is where the newest says
            if self._handle.poses:
                motion = _motion(self._handle.poses[-1], pose)
                distance, turn = _lengths(motion)
                if distance > _JUMP:
                    doubt = f"the handle has jumped by {1e3 * distance:.1f} mm"
                elif turn > _ROTATION_JUMP:
                    doubt = f"the handle has jumped by {math.degrees(turn):.0f}°"
                else:
                    self._motion = self._motion + motion
            self._handle.append_pose(stamp, pose)
            self._pose_time = time
        if doubt:
            return doubt
        if self._pose_time is None:
            return "no pose of the handle yet"
        if now - self._pose_time > 1e9 * self._settings.pose_timeout:
            return f"no pose of the handle for {1e-6 * (now - self._pose_time):.0f} ms"
        return "the clutch is held" if self._is_clutched else ""

    def _adopt(self, model: ContactModel, time: int) -> None:
        """Change to a newer model, if the handle's pose at its stamp is known."""
        stamp = model.stamp - self._time_offset
        if self._not_before is not None and stamp <= self._not_before:
            return
        anchor = self._handle.interpolate_at(stamp)
        if anchor is None:
            return
        before = self._model
        if before is not None and not self.doubt:
            # The wrench felt now fades into the new model's.
            handle = self._handle.poses[-1]
            _, old = before.compute_wrench(
                self._device.compute_probe_motion(before.pose, self._anchor, handle)
            )
            _, new = model.compute_wrench(
                self._device.compute_probe_motion(model.pose, anchor, handle)
            )
            self._left_over = old + self._left(time) - new
            self._since = time
        self._model, self._anchor, self._model_time = model, anchor, time
        self._not_before = stamp

    def _doubted(self, doubt: str) -> Array:
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

    def _left(self, now: int) -> Array:
        """Return the remainder (6,) N, N m of earlier models."""
        fraction = 1.0 - 1e-9 * (now - self._since) / self._settings.hand_over
        return self._left_over * min(max(fraction, 0.0), 1.0)

    def _unilateral(self, felt: Array) -> Array:
        """Return the wrench, less a force that would pull the handle against the tissue's push."""
        assert self._model is not None
        push = self._model.push @ self._device.to_patient
        pulled = float(felt[:3] @ push)
        if pulled < 0.0:
            felt[:3] -= pulled * push
        return felt

    def _limited(self, felt: Array) -> Array:
        """Return the wrench within the limits of the arm."""
        force, torque = _lengths(felt)
        if force > self._settings.force_limit:
            felt[:3] *= self._settings.force_limit / force
        if torque > self._settings.torque_limit:
            felt[3:] *= self._settings.torque_limit / torque
        return felt

    def _passive(self, felt: Array) -> Array:
        """Return the wrench, less the part along the motion that would return too much energy."""
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


def _motion(first: Pose, second: Pose) -> Array:
    """Return the motion (6,) m, rad between two poses of the handle, along the axes of the arm."""
    turn = se3.rotation_between(first.orientation, second.orientation)
    return np.concatenate([second.position - first.position, turn])


def _lengths(pair: Array) -> tuple[float, float]:
    """Return the norms of the first and of the last three numbers."""
    a, b, c, d, e, f = pair.tolist()
    return math.sqrt(a * a + b * b + c * c), math.sqrt(d * d + e * e + f * f)


class HapticDevice:
    """The coupling of a haptic arm's handle and the probe.

    The handle's translation is scaled, its rotation is not. While the clutch is held the probe
    stays; then it goes on from there, with the handle wherever it is. The registration is the pose
    of the arm's base in ``patient``, the calibration that of the probe in the handle's frame.
    """

    def __init__(
        self,
        settings: HapticSettings,
        registration: Pose | None = None,
        calibration: Pose | None = None,
    ) -> None:
        self._scale, self._force_scale = settings.scale, settings.force_scale
        #: Work on the handle over work on the probe.
        self.work_ratio = settings.force_scale / settings.scale
        registration, calibration = registration or Pose(), calibration or Pose()
        self.to_patient = registration.rotation  # (3, 3), of vectors along the arm's axes
        #: (3,) m, from the handle's origin to the probe's, along the probe's axes.
        self._lever = calibration.rotation.T @ calibration.position
        self.reset()

    def reset(self) -> None:
        """Forget the displacement of the handle's frame by the clutch."""
        self._offset = np.zeros(3)  # m, added to the scaled position
        self._regrip = Pose().orientation  # turns the handle in its own frame
        self._held: Pose | None = None  # where the body is kept
        self._last: Pose | None = None  # of the handle
        self.is_held = False

    def measure_body(self, pose: Pose, stamp: int) -> Measurement:
        """Measure the body that carries the probe, from the handle's pose, in the arm's frame.

        Args:
            stamp: ns.
            pose: of the handle in the arm's frame.
        """
        self._last = pose
        body = self._held or self._body(pose)
        if self.is_held:
            self._held = body
        return Measurement(stamp, body)

    def set_clutch(self, held: bool) -> None:
        """Hold the probe where it is, or let it go on from there."""
        if held and not self.is_held and self._last is not None:
            self._held = self._body(self._last)
        if not held and self._held is not None and self._last is not None:
            x, y, z, w = self._last.orientation
            self._offset = self._held.position - self._scale * self._last.position
            self._regrip = multiply_quaternions(np.array([-x, -y, -z, w]), self._held.orientation)
            self._held = None
        self.is_held = held

    def _body(self, pose: Pose) -> Pose:
        turned = multiply_quaternions(pose.orientation, self._regrip)
        return Pose(self._scale * pose.position + self._offset, turned)

    def compute_probe_motion(self, probe: Pose, before: Pose, now: Pose) -> Array:
        """Return the probe's motion with the handle's, whatever the clutch did earlier.

        Args:
            probe: in ``patient``, when the handle was at ``before``.
            before: of the handle in the arm's frame.
            now: of the handle in the arm's frame.

        Returns:
            (6,) m, rad: displacement of its origin, and rotation vector, axes of ``patient``.
        """
        moved = np.empty(6)
        moved[:3] = self.to_patient @ (self._scale * (now.position - before.position))
        moved[3:] = self.to_patient @ se3.rotation_between(before.orientation, now.orientation)
        if self._lever.any():
            arm = probe.rotation @ self._lever
            moved[:3] += _rotate(arm, moved[3:]) - arm
        return moved

    def compute_handle_wrench(self, probe: Pose, turn: Array, wrench: Array) -> Array:
        """Return the wrench (6,) N, N m on the handle, about its origin along the axes of the arm.

        Its work is that of the wrench on the probe times `work_ratio`, so a motion that takes no
        energy there takes none here.

        Args:
            probe: in ``patient``, before it has turned.
            turn: (3,) rad, its rotation vector since.
            wrench: (6,) N, N m, on the probe about its origin, axes of ``patient``.
        """
        force, torque = wrench[:3], wrench[3:]
        if self._lever.any():
            arm = _rotate(probe.rotation @ self._lever, turn)
            torque = torque + se3.cross_matrix(arm) @ force
        felt = np.empty(6)
        felt[:3] = self._force_scale * (force @ self.to_patient)
        felt[3:] = self.work_ratio * (torque @ self.to_patient)
        return felt


def _rotate(vector: Array, turn: Array) -> Array:
    """Turn a vector (3,) by a rotation vector (3,) rad."""
    return Pose(orientation=se3.rotation_exp(turn)).rotation @ vector
