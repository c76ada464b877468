"""Images sent to another process, and written with labels and displacements by their stamps."""

import cv2
import numpy as np
import pytest
from bench import pose_at
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image

from us_sim.errors import VolumeError
from us_sim.nodes.image_writer import ImageWriter
from us_sim.nodes.messages import image_message
from us_sim.recording.decoding import field_from

STAMP = Time(sec=3, nanosec=7)


@pytest.mark.parametrize("shape", [(5, 7), (1, 9, 4)])
def test_fields_come_back_as_they_were_sent(shape):
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    values.flat[3] = np.nan
    message = image_message(values, STAMP, "probe")
    assert message.encoding == f"32FC{shape[2] if len(shape) > 2 else 1}"
    assert (message.height, message.width, message.header.stamp) == (*shape[:2], STAMP)
    assert message.step * message.height == len(message.data) == 4 * values.size
    np.testing.assert_array_equal(field_from(message), values)


def test_padded_lines_are_read():
    message = image_message(np.arange(6, dtype=np.float32).reshape(3, 2), STAMP, "probe")
    lines = np.frombuffer(message.data, np.uint8).reshape(3, 8)
    message.data, message.step = np.pad(lines, ((0, 0), (0, 4))).tobytes(), 12
    np.testing.assert_array_equal(field_from(message), [[0, 1], [2, 3], [4, 5]])


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"encoding": "mono8"}, "mono8.*32FC1 to 32FC4"),
        ({"is_bigendian": 1}, "big-endian"),
        ({"step": 31}, " 31 "),
        ({"width": 0}, "3 .* 0 "),
    ],
)
def test_messages_that_are_no_field_are_refused(change, fact):
    message = image_message(np.zeros((3, 4, 2), np.float32), STAMP, "probe")
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(VolumeError, match=fact):
        field_from(message)


def test_each_goes_under_its_images_number_whichever_comes_first(bench, tmp_path):
    folders = {name: str(tmp_path / name) for name in ("folder", "labels", "displacement")}
    node = bench.make(ImageWriter, **folders)
    images, labels, fields = (
        bench.publisher(Image, f"ultrasound/{name}") for name in ("image", "labels", "displacement")
    )
    stamps = [pose_at(0.0, second).header.stamp for second in (1, 2, 3)]
    pixels = [np.full((4, 6), 10 * n, np.uint8) for n in range(3)]
    moved = [np.full((4, 6, 2), 0.1 * n, np.float32) for n in range(3)]
    for n in (0, 1, 2):
        if n == 1:  # labels that come before their image
            labels.publish(image_message(pixels[1] + 5, stamps[1], "probe"))
            bench.spin_until(lambda: node.counts["ultrasound/labels"] == 1)
        images.publish(image_message(pixels[n], stamps[n], "probe"))
        bench.spin_until(lambda n=n: node.counts["ultrasound/image"] == n + 1)
    labels.publish(image_message(pixels[2] + 5, stamps[2], "probe"))
    for n in (2, 0):  # of the middle image none comes
        fields.publish(image_message(moved[n], stamps[n], "probe"))
    bench.spin_until(lambda: node.counts.total() == 7)
    names = {file.name for file in (tmp_path / "labels").iterdir()}
    assert names == {"000001.png", "000002.png"}
    for n in (1, 2):
        written = cv2.imread(str(tmp_path / "labels" / f"00000{n}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(written, pixels[n] + 5)
    for n in (0, 2):
        written = np.load(tmp_path / "displacement" / f"00000{n}.npy")
        np.testing.assert_array_equal(written, moved[n])
    assert not (tmp_path / "displacement" / "000001.npy").exists()
