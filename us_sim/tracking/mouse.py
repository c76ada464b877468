"""A 6-DOF mouse that moves the probe, and the reports of a 3Dconnexion SpaceMouse.

Axes are those of ROS's `spacenav_node`: forward, left and up, then turns about these (REP 103),
each ±1 at full deflection.

>>> from us_sim.tracking.mouse import SixDofMouse
>>> mouse = SixDofMouse(SixDofMouseSettings(speed=["50 mm/s", "-50 mm/s", "-50 mm/s"]))
>>> for tick in range(101):  # a second at 100 Hz, pushed down
...     probe = mouse.move_probe([0.0, 0.0, -1.0, 0.0, 0.0, 0.0], [], tick * 10_000_000)
>>> probe.pose.position.round(6).tolist()  # from 10 mm above
[0.0, 0.0, 0.04]
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import SixDofMouseSettings

_LONGEST_GAP = 0.1  # s between two messages over which the velocity is still believed
_ROUNDING = 1e-3  # how far an axis may be beyond ±1: some drivers divide by a rounded full scale


class SixDofMouse:
    """Turns deflections of a cap into poses of the probe in ``patient``.

    A deflection is a velocity. While the clutch is held the probe stays where it is. At a side of
    the workspace the probe stops, and comes back as soon as the cap does.
    """

    def __init__(self, settings: SixDofMouseSettings) -> None:
        self._settings = settings
        self._used = list(settings.axes)
        self._full = np.array([*settings.speed, *settings.angular_speed])
        self._home = Pose(np.array(settings.home))
        self.last_problem = ""
        self.reset()

    def reset(self) -> None:
        """Bring the probe home and forget all messages."""
        self.pose = self._home
        self._stamp: int | None = None  # ns, of the last message
        self._twist = np.zeros(6)  # of the last message, m/s and rad/s
        self._held: dict[int, bool] = {}

    def move_probe(
        self, axes: Sequence[float], buttons: Sequence[int], stamp: int
    ) -> Measurement | None:
        """Move the probe by a message; None where that cannot be used: `last_problem` says why.

        Args:
            axes: deflections in ±1.
            buttons: 1 where pressed. One that is not listed is as it was: the usual driver lists
                those up to the one that has just changed, and none with a mere movement.
            stamp: ns.
        """
        deflection = self._deflection(axes)
        if deflection is None:
            return None
        step = 0.0 if self._stamp is None else 1e-9 * (stamp - self._stamp)
        if not 0.0 <= step <= _LONGEST_GAP:  # after a long gap, or where stamps jump back
            step = 0.0
        before = self._twist
        self._stamp, self._twist = stamp, self._full * deflection
        clutch, home = (
            self._is_held(button, buttons)
            for button in (self._settings.clutch_button, self._settings.reset_button)
        )
        if home:
            self.pose = self._home
        elif not clutch:
            # The velocity goes evenly from the last message's to this one's.
            pose = self.pose @ se3.exp(0.5 * step * (before + self._twist))
            low, high = self._settings.workspace_low, self._settings.workspace_high
            self.pose = Pose(np.clip(pose.position, low, high), pose.orientation)
        return Measurement(stamp, self.pose)

    def _deflection(self, axes: Sequence[float]) -> NDArray[np.float64] | None:
        """Return the (6,) deflections of the axes used, counted from the edge of the dead band."""
        last = max(self._used)
        if len(axes) <= last:
            self.last_problem = (
                f"the message has {len(axes)} axes, but axis {last} is used: remap the joystick, "
                f"or set six_dof_mouse.axes"
            )
            return None
        deflection = np.array([axes[axis] for axis in self._used], dtype=np.float64)
        if not np.isfinite(deflection).all():
            self.last_problem = f"the axes {deflection.tolist()} are not finite"
            return None
        beyond = int(np.abs(deflection).argmax())
        if abs(deflection[beyond]) > 1.0 + _ROUNDING:
            self.last_problem = (
                f"axis {self._used[beyond]} is {deflection[beyond]:g}, beyond 1: set the driver's "
                f"full scale to what the device gives at full deflection"
            )
            return None
        band = self._settings.dead_band
        past = np.clip((np.abs(deflection) - band) / (1.0 - band), 0.0, 1.0)
        return np.copysign(past, deflection)

    def _is_held(self, button: int, buttons: Sequence[int]) -> bool:
        if 0 <= button < len(buttons):
            self._held[button] = bool(buttons[button])
        return self._held.get(button, False)


FULL_DEFLECTION = 350.0  # the largest number that the device reports

_TRANSLATION, _ROTATION, _BUTTONS = 1, 2, 3  # numbers of reports
# The device's axes are right, towards the person, and down. Forward is against its second.
_ORDER = (1, 0, 2, 4, 3, 5)
_LOGITECH, _3DCONNEXION = 0x046D, 0x256F
# Before 3Dconnexion had a number of its own: SpaceMouse Plus XT to SpaceMouse Pro.
_LOGITECH_PRODUCTS = range(0xC603, 0xC62C)
_MULTI_AXIS = (1, 8)  # HID usage page and usage of a multi-axis controller
_REPORT_BYTES = 64


class SpaceMouseReports:
    """The state of a device, from the reports that it sends when something changes."""

    def __init__(self) -> None:
        #: Six deflections in ±1: forward, left, up, and turns about these.
        self.axes = [0.0] * 6
        #: 1 for each that is pressed.
        self.buttons = [0, 0]

    def parse_report(self, report: bytes) -> bool:
        """Parse a report; return whether it is about axes or buttons.

        Older devices send translation and rotation one after the other, newer ones together.
        """
        if not report:
            return False
        kind, body = report[0], report[1:]
        if kind == _TRANSLATION and len(body) >= 12:
            self._deflect(0, struct.unpack_from("<6h", body))
        elif kind in (_TRANSLATION, _ROTATION) and len(body) >= 6:
            self._deflect(3 * (kind == _ROTATION), struct.unpack_from("<3h", body))
        elif kind == _BUTTONS and body:
            pressed = int.from_bytes(body, "little")
            count = max(len(self.buttons), pressed.bit_length())
            self.buttons = [pressed >> number & 1 for number in range(count)]
        else:
            return False
        return True

    def _deflect(self, first: int, raw: tuple[int, ...]) -> None:
        for axis, source in enumerate(_ORDER):
            if first <= source < first + len(raw):
                value = -raw[source - first] / FULL_DEFLECTION
                self.axes[axis] = max(-1.0, min(1.0, value)) + 0.0  # without a negative zero


class SpaceMouse(SpaceMouseReports):
    """The first SpaceMouse that is plugged in.

    Raises:
        TrackingError: none is there, it may not be opened, or hidapi is not installed.
    """

    def __init__(self) -> None:
        super().__init__()
        try:
            import hid
        except ImportError as error:
            raise TrackingError(
                f"a SpaceMouse needs the library hidapi ({error}): pip install "
                f"'us_sim[space_mouse]'"
            ) from error
        found = [entry for entry in hid.enumerate() if _is_space_mouse(entry)]
        if not found:
            raise TrackingError("no SpaceMouse is plugged in: plug it in, or pair it")
        # One device may show itself several times: as a controller, a keyboard, a battery.
        found.sort(key=lambda entry: (entry["usage_page"], entry["usage"]) != _MULTI_AXIS)
        self.name = found[0].get("product_string") or "SpaceMouse"
        self._device = hid.device()
        try:
            self._device.open_path(found[0]["path"])
        except OSError as error:
            raise TrackingError(
                f"{self.name} cannot be opened ({error}): give yourself access to its hidraw "
                f"device (Linux: a udev rule for vendor {found[0]['vendor_id']:04x}), or end the "
                f"program that uses it"
            ) from error

    def wait_for_report(self, seconds: float) -> bool:
        """Wait for the next report; return whether one came and changed something.

        Raises:
            TrackingError: the device is gone.
        """
        try:
            report = self._device.read(_REPORT_BYTES, max(round(seconds * 1e3), 1))
        except (OSError, ValueError) as error:
            raise TrackingError(f"{self.name} is gone ({error}): plug it in again") from error
        return self.parse_report(bytes(report))

    def close(self) -> None:
        """Close the device."""
        self._device.close()


def _is_space_mouse(entry: dict[str, Any]) -> bool:
    vendor, product = entry["vendor_id"], entry["product_id"]
    return vendor == _3DCONNEXION or (vendor == _LOGITECH and product in _LOGITECH_PRODUCTS)
