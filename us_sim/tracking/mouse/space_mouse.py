"""A 3Dconnexion SpaceMouse as its own reports, without the manufacturer's or any other driver.

The axes are those of ROS's `spacenav_node`: forward, left and up, then turns about these (REP
103), each ±1 at full deflection.

>>> import struct
>>> from us_sim.tracking.mouse.space_mouse import SpaceMouseReports
>>> reports = SpaceMouseReports()
>>> reports.take(struct.pack("<B3h", 1, 0, -175, 350))  # half forward and fully down
True
>>> reports.axes
[0.5, 0.0, -1.0, 0.0, 0.0, 0.0]
>>> reports.take(bytes([3, 0b10]))
True
>>> reports.buttons
[0, 1]
"""

from __future__ import annotations

import struct
from typing import Any

from us_sim.errors import TrackingError

FULL_DEFLECTION = 350.0
"""The largest number that the device reports."""

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
        self.axes = [0.0] * 6
        self.buttons = [0, 0]

    def take(self, report: bytes) -> bool:
        """Take a report; returns whether it is about axes or buttons.

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


class SpaceMouse:
    """The first SpaceMouse that is plugged in.

    Raises:
        TrackingError: none is there, it may not be opened, or hidapi is not installed.
    """

    def __init__(self) -> None:
        hid = _hidapi()
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
        self._reports = SpaceMouseReports()

    @property
    def axes(self) -> list[float]:
        """Six deflections in ±1: forward, left, up, and turns about these."""
        return list(self._reports.axes)

    @property
    def buttons(self) -> list[int]:
        """1 for each that is pressed."""
        return list(self._reports.buttons)

    def wait(self, seconds: float) -> bool:
        """Take the next report, if one comes in time; whether something has changed.

        Raises:
            TrackingError: the device is gone.
        """
        try:
            report = self._device.read(_REPORT_BYTES, max(round(seconds * 1e3), 1))
        except (OSError, ValueError) as error:
            raise TrackingError(f"{self.name} is gone ({error}): plug it in again") from error
        return self._reports.take(bytes(report))

    def close(self) -> None:
        """Let go of the device."""
        self._device.close()


def _hidapi() -> Any:
    try:
        import hid
    except ImportError as error:
        raise TrackingError(
            f"a SpaceMouse needs the library hidapi ({error}): pip install 'us_sim[space_mouse]'"
        ) from error
    return hid


def _is_space_mouse(entry: dict[str, Any]) -> bool:
    vendor, product = entry["vendor_id"], entry["product_id"]
    return vendor == _3DCONNEXION or (vendor == _LOGITECH and product in _LOGITECH_PRODUCTS)
