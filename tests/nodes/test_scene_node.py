"""Newest wins: what came while a node worked is skipped and counted."""

import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped

from us_sim.nodes.scene_node import SceneNode


class Consumer(SceneNode):
    """A node that is sent eight more poses while it works on the first."""

    def __init__(self, **kwargs):
        super().__init__("consumer", **kwargs)
        self.worked = []
        self.newest(PoseStamped, "probe/pose", self._work)

    def _work(self, message):
        self.worked.append(message.header.stamp.sec)
        if len(self.worked) == 1:
            for second in range(2, 10):
                self.sender.publish(pose_at(0.0, second))


class Slow(SceneNode):
    """A node to which more comes while it works than its queue of ten holds."""

    def __init__(self, **kwargs):
        super().__init__("slow", **kwargs)
        self.worked = []
        self.newest(PoseStamped, "probe/pose", self._work)

    def _work(self, message):
        self.worked.append(message.header.stamp.sec)
        for _ in range(self.more.pop(0) if self.more else 0):
            self.sent += 1
            self.sender.publish(pose_at(0.0, self.sent))


def test_what_a_full_queue_overwrites_counts_as_dropped(bench, small_scene):
    node = bench.make(Slow, scene=str(small_scene))
    node.sender, node.sent, node.more = bench.publisher(PoseStamped, "probe/pose"), 1, [3, 40]
    node.sender.publish(pose_at(0.0, 1))
    bench.spin_until(lambda: node.worked[-1:] == [44])
    assert node.worked == [1, 4, 44]
    assert node.health.dropped == 44 - len(node.worked)
    assert node.health.received < 44


@pytest.mark.parametrize(
    ("lockstep", "worked", "dropped"), [(False, [1, 9], 7), (True, [*range(1, 10)], 0)]
)
def test_live_the_last_of_a_burst_is_worked_on_and_in_lockstep_all(
    bench, small_scene, lockstep, worked, dropped
):
    node = bench.make(Consumer, scene=str(small_scene), lockstep=lockstep)
    node.sender = bench.publisher(PoseStamped, "probe/pose")
    node.sender.publish(pose_at(0.0, 1))
    bench.spin_until(lambda: node.health.received == 9)
    bench.spin_for(10)
    assert (node.worked, node.health.dropped) == (worked, dropped)
