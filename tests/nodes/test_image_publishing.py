"""Sending images to another process, as fast as a display shows them."""

import subprocess
import sys
import time

import numpy as np
import pytest
from sensor_msgs.msg import Image

from us_sim.nodes.messages import image_message
from us_sim.nodes.qos import STREAM

WATCHER = """
import numpy as np
import us_sim.nodes
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import Image
from us_sim.nodes.messages import pixels_from
from us_sim.nodes.qos import STREAM

sums = []

def take(message):
    sums.append(int(pixels_from(message).sum()))

rclpy.init()
node = Node("watcher")
node.create_subscription(Image, "ultrasound/image", take, STREAM)
while not sums or sums[-1] != 0:
    rclpy.spin_once(node, timeout_sec=1.0)
print(len(sums), sum(sums))
"""


@pytest.fixture
def watcher():
    """Another process that takes images until a black one comes."""
    child = subprocess.Popen([sys.executable, "-c", WATCHER], stdout=subprocess.PIPE, text=True)
    yield child
    child.kill()
    child.communicate()


def test_an_image_of_512_by_512_takes_two_milliseconds_of_a_core_at_most(bench, watcher):
    pixels = np.random.default_rng(4).integers(1, 256, (512, 512), dtype=np.uint8)
    publisher = bench.peer.create_publisher(Image, "ultrasound/image", STREAM)
    bench.spin_until(lambda: publisher.get_subscription_count() > 0)
    stamp = bench.peer.get_clock().now().to_msg()
    seconds = []
    due = time.perf_counter()
    for _ in range(150):
        due += 1 / 60
        time.sleep(max(0.0, due - time.perf_counter()))
        start = time.thread_time()
        publisher.publish(image_message(pixels, stamp, "probe"))
        seconds.append(time.thread_time() - start)
    publisher.publish(image_message(0 * pixels, stamp, "probe"))
    count, total = map(int, watcher.communicate(timeout=30)[0].split())
    assert count > 1
    assert total == (count - 1) * int(pixels.sum())
    assert np.median(seconds) < 2e-3
