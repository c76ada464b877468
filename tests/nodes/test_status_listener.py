"""The status board fed by real messages, only while somebody looks."""

import math
from time import monotonic as now

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped

from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.posted import Posted
from us_sim.viewer.status import Level, StatusListener


def test_nodes_and_the_force_are_heard_while_somebody_looks(bench):
    listening = bench.add(GuardedNode("viewer", context=bench.context))
    listener = StatusListener(listening, Posted(listening))
    board = listener.board
    node = bench.add(GuardedNode("tissue_deformer", context=bench.context))
    node.health = Health(node, "arm")
    wrenches = bench.peer.create_publisher(WrenchStamped, "probe/wrench", 10)
    bench.spin_for(5)
    assert bench.peer.count_subscribers("diagnostics") == 0
    board.watch(pages=1)
    bench.spin_until(lambda: bench.peer.count_subscribers("diagnostics") == 1)
    node.health.state = "fem"

    def heard():
        node.health.report()
        return any(s.name == "tissue_deformer" and s.state == "fem" for s in board.nodes(now()))

    bench.spin_until(heard)
    assert board.node("tissue_deformer", now()).level is Level.WELL
    node.health.problem("pose", "the pose is nonsense")

    def warned():
        node.health.report()
        return board.node("tissue_deformer", now()).problem == "the pose is nonsense"

    bench.spin_until(warned)
    assert bench.peer.count_subscribers("probe/wrench") == 0

    board.watch(plots=1)
    bench.spin_until(lambda: wrenches.get_subscription_count() == 1)
    message = WrenchStamped()
    message.wrench.force.x, message.wrench.force.z = 3.0, -4.0
    message.header.stamp.sec = 1
    wrenches.publish(message)
    bench.spin_until(lambda: board.forces(since=0.0))
    assert math.isclose(board.forces(since=0.0)[0][1], 5.0)

    foreign = bench.peer.create_publisher(DiagnosticArray, "diagnostics", 10)
    status = DiagnosticStatus(name="camera: lens", level=DiagnosticStatus.ERROR, message="dirty")
    bench.spin_until(lambda: foreign.get_subscription_count() == 1)
    foreign.publish(DiagnosticArray(status=[status]))
    bench.spin_until(lambda: board.node("camera: lens", now()) is not None)
    assert board.node("camera: lens", now()).level is Level.ERROR

    board.watch(pages=-1, plots=-1)
    bench.spin_until(lambda: bench.peer.count_subscribers("diagnostics") == 0)
    assert wrenches.get_subscription_count() == 0
