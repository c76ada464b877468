"""A SpaceMouse's reports as `spacenav_node` would publish them; the device is one of paper."""

import struct
import sys
import time
from types import SimpleNamespace

import pytest
from sensor_msgs.msg import Joy

from us_sim.errors import TrackingError
from us_sim.nodes.space_mouse_driver import SpaceMouseDriver
from us_sim.tracking.space_mouse import SpaceMouse

# In the device's frame: right, towards the person, down.
RIGHT, BACK, DOWN = 0, 1, 2


def deflected(axis, value, *, first=1):
    raw = [0, 0, 0]
    raw[axis] = value
    return struct.pack("<B3h", first, *raw)


class PaperDevice:
    """A stand-in for `hid` with one device, which sends ``reports`` and can be pulled out."""

    def __init__(self):
        self.reports, self.is_there, self.may_open, self.opened = [], True, True, []

    def enumerate(self):
        entry = {"vendor_id": 0x256F, "product_id": 0xC635, "product_string": "Paper"}
        keyboard = {"vendor_id": 0x046D, "product_id": 0xC31C, "usage_page": 1, "usage": 6}
        parts = [
            entry | {"usage_page": 1, "usage": 6, "path": b"keys"},
            entry | {"usage_page": 1, "usage": 8, "path": b"cap"},
        ]
        return [keyboard | {"path": b"other"}, *(parts if self.is_there else [])]

    def device(self):
        return SimpleNamespace(open_path=self._open, read=self._read, close=lambda: None)

    def _open(self, path):
        if not self.may_open:
            raise OSError("open failed")
        self.opened.append(path)

    def _read(self, _, timeout_ms):
        if not self.is_there:
            raise OSError("read error")
        if not self.reports:
            time.sleep(timeout_ms * 1e-3)
            return []
        return list(self.reports.pop(0))


@pytest.fixture
def device(monkeypatch):
    device = PaperDevice()
    monkeypatch.setitem(sys.modules, "hid", device)
    monkeypatch.setattr("us_sim.nodes.device_driver.RETRY_S", 0.02)
    return device


@pytest.fixture
def send(device):
    """Send reports to a mouse, and return it."""
    mouse = SpaceMouse()

    def send(*reports):
        for report in reports:
            device.reports.append(report)
            mouse.wait_for_report(0.0)
        return mouse

    return send


@pytest.mark.parametrize(
    ("axis", "published"), [(BACK, 0), (RIGHT, 1), (DOWN, 2)], ids=["forward", "left", "up"]
)
@pytest.mark.parametrize("first", [1, 2], ids=["moved", "turned"])
def test_axes_are_forward_left_and_up_and_turns_about_them(send, axis, published, first):
    expected = [0.0] * 6
    expected[published + 3 * (first == 2)] = 1.0
    assert send(deflected(axis, -350, first=first)).axes == expected
    assert min(send(deflected(axis, 700, first=first)).axes) == -1.0


def test_newer_devices_send_all_six_axes_at_once(send):
    report = struct.pack("<B6h", 1, -35, -70, -105, -140, -175, -210)
    assert send(report).axes == pytest.approx([0.2, 0.1, 0.3, 0.5, 0.4, 0.6])


def test_older_devices_send_translation_and_rotation_one_after_the_other(send):
    mouse = send(deflected(BACK, -35), deflected(BACK, -70, first=2), deflected(DOWN, -105))
    assert mouse.axes == pytest.approx([0.0, 0.0, 0.3, 0.2, 0.0, 0.0])


def test_what_is_no_report_changes_nothing(send):
    mouse = send(deflected(BACK, -350), bytes([3, 1]))
    send(b"", b"\1", b"\1\0\0", b"\x17\x50", b"\3", bytes(64))
    assert (mouse.axes, mouse.buttons) == ([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [1, 0])


def test_as_many_buttons_as_have_been_pressed(send):
    assert send(struct.pack("<BI", 3, 1 << 12 | 1)).buttons == [1] + [0] * 11 + [1]
    assert send(struct.pack("<BI", 3, 0)).buttons == [0] * 13


def test_the_cap_is_opened_and_its_state_repeated(bench, device):
    node = bench.make(SpaceMouseDriver)
    joys = bench.collect(Joy, "spacenav/joy")
    bench.spin_until(lambda: joys)
    assert device.opened == [b"cap"]
    assert (list(joys[-1].axes), list(joys[-1].buttons)) == ([0.0] * 6, [0, 0])
    device.reports += [deflected(BACK, -175), deflected(DOWN, 350, first=2), bytes([3, 1])]
    bench.spin_until(lambda: joys[-1].buttons[0] == 1)
    assert list(joys[-1].axes) == [0.5, 0, 0, 0, 0, -1.0]
    count = len(joys)
    bench.spin_until(lambda: len(joys) > count + 3)
    assert joys[-1].header.stamp != joys[-2].header.stamp
    assert node.health.state == "Paper"


def test_a_device_that_is_pulled_out_is_waited_for(bench, device):
    device.is_there = False
    node = bench.make(SpaceMouseDriver)
    joys = bench.collect(Joy, "spacenav/joy")
    bench.spin_until(lambda: node.health.problems["device"] > 0)
    for _ in range(2):
        device.is_there = True
        joys.clear()
        bench.spin_until(lambda: joys)
        device.is_there = False
        problems = node.health.problems["device"]
        bench.spin_until(lambda before=problems: node.health.problems["device"] > before + 1)
    assert node.health.state == "no device"
    assert "plug it in" in node.health.fault


def test_sentences_say_what_to_do(device, monkeypatch):
    device.may_open = False
    with pytest.raises(TrackingError, match="udev"):
        SpaceMouse()
    device.is_there = False
    with pytest.raises(TrackingError, match="plug it in"):
        SpaceMouse()
    monkeypatch.setitem(sys.modules, "hid", None)
    with pytest.raises(TrackingError, match=r"pip install 'us_sim\[space_mouse\]'"):
        SpaceMouse()
