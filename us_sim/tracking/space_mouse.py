"""A 3Dconnexion SpaceMouse by hidapi, with the axes of ROS's `spacenav_node`."""

from __future__ import annotations

import numpy as np

from us_sim.errors import TrackingError

FULL_DEFLECTION = 350.0  # the largest number that the device reports
_TRANSLATION, _ROTATION, _BUTTONS = 1, 2, 3  # numbers of reports
_ORDER = [1, 0, 2, 4, 3, 5]
"""Forward, left, up and turns about these: the device has right, towards the person, down."""
_PRODUCTS = {0x256F: range(0x10000), 0x046D: range(0xC603, 0xC62C)}
"""By vendor: 3Dconnexion, and Logitech, whose number the SpaceMouse Plus XT to Pro have."""
_MULTI_AXIS = (1, 8)  # HID usage page and usage of a multi-axis controller


class SpaceMouse:
    """The first SpaceMouse that is plugged in.

    Raises:
        TrackingError: none is there, it may not be opened, or hidapi is not installed.
    """

    def __init__(self) -> None:
        try:
            import hid
        except ImportError as error:
            raise TrackingError(
                f"a SpaceMouse needs the library hidapi ({error}): pip install "
                f"'us_sim[space_mouse]'"
            ) from error
        found = [d for d in hid.enumerate() if d["product_id"] in _PRODUCTS.get(d["vendor_id"], ())]
        if not found:
            raise TrackingError("no SpaceMouse is plugged in: plug it in, or pair it")
        # One device may show itself several times: as a controller, a keyboard, a battery.
        best = min(found, key=lambda d: (d["usage_page"], d["usage"]) != _MULTI_AXIS)
        self.name = best.get("product_string") or "SpaceMouse"
        self.axes = [0.0] * 6  # ±1: forward, left, up, and turns about these
        self.buttons = [0, 0]  # 1 for each that is pressed
        self._raw = np.zeros(6)
        self._device = hid.device()
        try:
            self._device.open_path(best["path"])
        except OSError as error:
            raise TrackingError(
                f"{self.name} cannot be opened ({error}): give yourself access to its hidraw "
                f"device (Linux: a udev rule for vendor {best['vendor_id']:04x}), or end the "
                f"program that uses it"
            ) from error

    def wait_for_report(self, seconds: float) -> None:
        """Update axes or buttons by the next report, if it comes in time.

        Raises:
            TrackingError: the device is gone.
        """
        try:
            kind, *body = self._device.read(64, max(round(1e3 * seconds), 1)) or [0]
        except (OSError, ValueError) as error:
            raise TrackingError(f"{self.name} is gone ({error}): plug it in again") from error
        if kind in (_TRANSLATION, _ROTATION) and len(body) >= 6:
            # Older devices send translation and rotation one after the other, newer ones together.
            first = 3 if kind == _ROTATION else 0
            count = 6 if kind == _TRANSLATION and len(body) >= 12 else 3
            self._raw[first : first + count] = np.frombuffer(bytes(body), "<i2", count)
            deflections = np.clip(-self._raw[_ORDER] / FULL_DEFLECTION, -1.0, 1.0)
            self.axes = (deflections + 0.0).tolist()  # without a negative zero
        elif kind == _BUTTONS and body:
            pressed = int.from_bytes(body, "little")
            count = max(len(self.buttons), pressed.bit_length())
            self.buttons = [pressed >> number & 1 for number in range(count)]

    def close(self) -> None:
        """Close the device."""
        self._device.close()
