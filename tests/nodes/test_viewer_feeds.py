"""What streams to pages: subscribed to while watched, decoded when taken, or refused."""

import cv2
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import affine_message, colour_image_message, image_message
from us_sim.nodes.posted import Posted
from us_sim.nodes.qos import LATCHED
from us_sim.viewer.feeds import image_feeds


class Watcher(GuardedNode):
    """A node with the feeds of a viewer, and no web server."""

    def __init__(self, **kwargs):
        super().__init__("watcher", **kwargs)
        self.health = Health(self, "test")
        self.post = Posted(self)
        self.arranged = False, False
        feeds = image_feeds(
            self, self.post, 30.0, lambda stamp: {"known": stamp}, lambda: self.arranged
        )
        self.feeds = {feed.kind: feed for feed in feeds}


@pytest.fixture
def watcher(bench):
    return bench.make(Watcher)


def nothing() -> None:
    """Who watches is told nothing."""


def speckle(*shape: int):
    return np.random.default_rng(2).integers(0, 256, shape, dtype=np.uint8)


def test_a_topic_is_subscribed_to_only_while_watched(bench, watcher):
    publisher = bench.peer.create_publisher(Image, "ultrasound/image", 10)
    bench.spin_for(5)
    assert publisher.get_subscription_count() == 0
    feed = watcher.feeds["image"]
    feed.watch(nothing)
    bench.spin_until(lambda: publisher.get_subscription_count() == 1)
    feed.unwatch(nothing)
    bench.spin_until(lambda: publisher.get_subscription_count() == 0)


def test_watching_on_and_off_at_once_ends_as_it_was_left(bench, watcher):
    publisher = bench.peer.create_publisher(Image, "ultrasound/image", 10)
    feed = watcher.feeds["image"]
    for _ in range(3):
        feed.watch(nothing)
        feed.unwatch(nothing)
    feed.watch(nothing)
    bench.spin_until(lambda: publisher.get_subscription_count() == 1)
    bench.spin_for(5)
    assert publisher.get_subscription_count() == 1


def test_pixels_and_stamp_come_as_they_were_published(bench, watcher):
    feed, pixels = watcher.feeds["image"], speckle(40, 30)
    feed.watch(nothing)
    publisher = bench.publisher(Image, "ultrasound/image")
    publisher.publish(image_message(pixels, Time(sec=7, nanosec=9), "probe"))
    bench.spin_until(lambda: feed.sequence == 1)
    packet = feed.newest()
    assert packet.header == {
        "stamp": "7000000009",
        "rows": 40,
        "columns": 30,
        "encoding": "mono8",
        "known": 7000000009,
    }
    np.testing.assert_array_equal(np.frombuffer(packet.payload, np.uint8).reshape(40, 30), pixels)


@pytest.mark.parametrize(
    ("kind", "topic"),
    [
        ("annotated", "ultrasound/image_annotated"),
        ("m_mode", "ultrasound/m_mode"),
        ("spectrum", "ultrasound/spectrum"),
    ],
)
def test_pictures_keep_their_colours(bench, watcher, kind, topic):
    feed, picture = watcher.feeds[kind], np.zeros((48, 64, 3), np.uint8)
    picture[:, :32] = 200, 60, 30  # red
    feed.watch(nothing)
    publisher = bench.publisher(Image, topic)
    publisher.publish(colour_image_message(picture, Time(), "probe"))
    bench.spin_until(lambda: feed.sequence == 1)
    decoded = cv2.imdecode(np.frombuffer(feed.newest().payload, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(decoded[24, 10].astype(int) - (30, 60, 200)).max() <= 6
    assert decoded[24, 55].max() <= 6


def test_a_jpeg_of_speckle_is_near_what_it_was(bench, watcher):
    feed = watcher.feeds["image_jpeg"]
    smooth = cv2.GaussianBlur(speckle(256, 256), (0, 0), 2.0)
    feed.watch(nothing)
    publisher = bench.publisher(Image, "ultrasound/image")
    publisher.publish(image_message(smooth, Time(), "probe"))
    bench.spin_until(lambda: feed.sequence == 1)
    packet = feed.newest()
    decoded = cv2.imdecode(np.frombuffer(packet.payload, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(decoded.astype(int) - smooth).mean() < 1.5
    assert len(packet.payload) < 0.5 * smooth.size


def test_an_image_says_where_its_pixels_are_and_what_else_is_known(bench, watcher):
    matrix = np.array([[1e-4, 0, 0, -0.02], [0, 0, 1, 0], [0, 2e-4, 0, 1e-4], [0, 0, 0, 1.0]])
    places = bench.peer.create_publisher(Float64MultiArray, "ultrasound/image_to_probe", LATCHED)
    places.publish(affine_message(matrix))
    feed = watcher.feeds["image"]
    feed.watch(nothing)
    publisher = bench.publisher(Image, "ultrasound/image")

    pixels = speckle(40, 30)

    def newest():
        publisher.publish(image_message(pixels, Time(sec=7), "probe"))
        packet = feed.newest()
        return packet if packet and "matrix" in packet.header else None

    packet = bench.spin_until(newest) or newest()
    assert packet.header["matrix"] == matrix.ravel().tolist()
    assert packet.header["known"] == 7 * 10**9
    watcher.arranged, last = (True, True), feed.sequence
    bench.spin_until(lambda: newest() and feed.sequence > last)
    packet = newest()
    shown = np.frombuffer(packet.payload, np.uint8).reshape(40, 30)
    np.testing.assert_array_equal(shown, pixels[:, ::-1])
    flipped = np.reshape(packet.header["matrix"], (4, 4))
    for column, row in ((0, 0), (29, 3)):
        there, here = flipped @ [29 - column, row, 0, 1], matrix @ [column, row, 0, 1]
        np.testing.assert_allclose(there, here, atol=1e-15)


@pytest.mark.parametrize(
    ("kind", "message", "sentence"),
    [
        ("image", {"encoding": "rgb8"}, "must be mono8"),
        ("image", {"height": 1000}, "1000 rows"),
        ("image_jpeg", {"width": 0}, "0 pixels"),
        ("annotated", {"encoding": "mono8"}, "must be rgb8"),
    ],
)
def test_what_cannot_be_shown_is_said_and_the_next_is_shown(
    bench, watcher, kind, message, sentence
):
    feed = watcher.feeds[kind]
    feed.watch(nothing)
    topic = "ultrasound/image_annotated" if kind == "annotated" else "ultrasound/image"
    publisher = bench.publisher(Image, topic)
    odd = image_message(speckle(4, 4), Time(), "probe")
    for name, value in message.items():
        setattr(odd, name, value)
    publisher.publish(odd)
    bench.spin_until(lambda: feed.sequence == 1)
    assert feed.newest() is None
    assert watcher.health.problems("volume") == 1
    assert sentence in watcher.health._last_problem
    good = speckle(4, 4, 3)
    sound = colour_image_message(good, Time(), "probe") if kind == "annotated" else None
    publisher.publish(sound or image_message(good[..., 0], Time(), "probe"))
    bench.spin_until(lambda: feed.sequence == 2)
    assert feed.newest() is not None


def test_posted_work_is_done_in_order_and_tells_its_end(bench, watcher):
    done = []
    futures = [watcher.post(lambda i=i: done.append(i) or i) for i in range(5)]
    failing = watcher.post(lambda: 1 // 0)
    bench.spin_until(failing.done)
    assert done == [future.result() for future in futures] == list(range(5))
    assert isinstance(failing.exception(), ZeroDivisionError)
    waiting = watcher.post(lambda: done.append("never"))
    watcher.post.close()
    assert waiting.cancelled()
    assert watcher.post(lambda: None).cancelled()
    bench.spin_for(3)
    assert done == list(range(5))


def test_of_two_images_beside_each_other_the_left_ones_pixels_are_known(bench, watcher):
    matrix = np.array([[1e-4, 0, 0, -0.02], [0, 0, 1, 0], [0, 2e-4, 0, 1e-4], [0, 0, 0, 1.0]])
    places = bench.peer.create_publisher(Float64MultiArray, "ultrasound/image_to_probe", LATCHED)
    places.publish(affine_message(matrix))
    watcher.arranged = True, True
    feed = watcher.feeds["annotated"]
    feed.watch(nothing)
    publisher = bench.publisher(Image, "ultrasound/image_annotated")

    def header():
        message = colour_image_message(np.zeros((40, 60, 3), np.uint8), Time(), "probe")
        publisher.publish(message)
        packet = feed.newest()
        return packet.header if packet and "matrix" in packet.header else None

    bench.spin_until(header)
    assert header()["panels"] == 2
    there = np.reshape(header()["matrix"], (4, 4)) @ [29, 3, 0, 1]
    np.testing.assert_allclose(there, matrix @ [0, 3, 0, 1], atol=1e-15)
