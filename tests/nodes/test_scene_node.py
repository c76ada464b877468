"""Newest wins: what came while a node worked is skipped and counted."""

from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node

from us_sim.nodes.guarded_node import Health
from us_sim.nodes.qos import EVERY
from us_sim.nodes.scene_node import Newest


def consumer(bench, publisher_count, *, lockstep):
    """A node that is sent ``publisher_count`` more poses while it works on the first."""
    node = bench.add(Node("consumer", context=bench.context))
    health = Health(node, "test")
    worked = []

    def work(message):
        worked.append(message.header.stamp.sec)
        if len(worked) == 1:
            for second in range(2, 2 + publisher_count):
                publisher.publish(pose_at(0.0, second))

    take = Newest(node, health, work, lockstep=lockstep)
    node.create_subscription(PoseStamped, "probe/pose", take, EVERY)
    publisher = bench.publisher(PoseStamped, "probe/pose")
    publisher.publish(pose_at(0.0, 1))
    bench.spin_until(lambda: health.received == 1 + publisher_count)
    bench.spin_for(10)
    return worked, health


def test_live_the_last_of_a_burst_is_worked_on_and_the_rest_counted(bench):
    worked, health = consumer(bench, 8, lockstep=False)
    assert worked == [1, 9]
    assert health.dropped == 7


def test_lockstep_works_on_every_one_in_order(bench):
    worked, health = consumer(bench, 8, lockstep=True)
    assert worked == list(range(1, 10))
    assert health.dropped == 0
