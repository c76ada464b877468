"""What sending an image to another process costs the one that sends it.

Run as `python -m us_sim.evaluation.slice.publishing SIDE`, it publishes images of SIDE × SIDE
pixels at 60 Hz to a subscriber in a second process, and prints the median milliseconds of making
and publishing a message.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

from us_sim.evaluation.own_process import start_module

_IMAGES = 180
_RATE = 60.0  # Hz
_LONGEST = 60.0  # s, after which nothing is waited for
_MODULE, _WATCH = "us_sim.evaluation.slice.publishing", "watch"
_NODE, _TOPIC = "slice_publishing", "us_sim_slice_publishing/image"


def publishing_ms(side: int) -> float | None:
    """ms of a process that sends an image of ``side`` × ``side`` pixels; None where none went."""
    watcher = start_module(_MODULE, _WATCH)
    sender = start_module(_MODULE, str(side))
    try:
        return float(sender.communicate(timeout=2 * _LONGEST)[0])
    except (subprocess.TimeoutExpired, ValueError):
        return None
    finally:
        for process in (watcher, sender):
            process.kill()
            process.communicate()


def _watch() -> None:
    import us_sim.nodes  # noqa: F401 - provides rclpy where ROS 2 is not installed

    import rclpy  # isort: skip
    from rclpy.node import Node
    from sensor_msgs.msg import Image

    from us_sim.nodes.qos import STREAM

    rclpy.init()
    node = Node(f"{_NODE}_watcher")
    node.create_subscription(Image, _TOPIC, lambda _: None, STREAM)
    rclpy.spin(node)


def _publish(side: int) -> float | None:
    import us_sim.nodes  # noqa: F401

    import rclpy  # isort: skip
    import numpy as np
    from rclpy.node import Node
    from sensor_msgs.msg import Image

    from us_sim.nodes.conversions import image_message
    from us_sim.nodes.qos import STREAM

    rclpy.init()
    node = Node(_NODE)
    publisher = node.create_publisher(Image, _TOPIC, STREAM)
    pixels = np.random.default_rng(1).integers(0, 256, (side, side), dtype=np.uint8)
    stamp = node.get_clock().now().to_msg()
    begin = time.perf_counter()
    while publisher.get_subscription_count() == 0:
        if time.perf_counter() - begin > _LONGEST:
            return None
        time.sleep(0.05)
    found = []
    due = time.perf_counter()
    for _ in range(_IMAGES):
        due += 1.0 / _RATE
        time.sleep(max(0.0, due - time.perf_counter()))
        before = time.perf_counter()
        publisher.publish(image_message(pixels, stamp, "probe"))
        found.append((time.perf_counter() - before) * 1e3)
    return statistics.median(found)


if __name__ == "__main__":
    if sys.argv[1] == _WATCH:
        _watch()
    else:
        print(_publish(int(sys.argv[1])))
