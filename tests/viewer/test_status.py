"""The state of nodes for pages: newest status, problems and silence.

The status board fed by real messages, only while somebody looks.
"""

import time
from time import monotonic as now

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.viewer.status import GONE_S, NodeLevel, NodeStatus, StatusBoard, StatusListener
from us_sim.viewer.stream import CallPoster

VALUES = {
    "state": "fem",
    "rate_hz": "59.5",
    "received": "120",
    "dropped": "4",
    "rejected pose": "2",
    "rejected setting": "1",
    "failed timer x": "3",
    "latency_p50_ms": "7.25",
    "residual": "nan",
}


def said(
    name: str = "tissue_deformer", level: NodeLevel = NodeLevel.WELL, **values: str
) -> NodeStatus:
    return NodeStatus(name, level, "fem", VALUES | values)


def test_the_numbers_that_a_node_says_are_read():
    status = said()
    assert (status.read_number("rate_hz"), status.read_number("dropped"), status.problems) == (
        59.5,
        4,
        6,
    )
    assert (status.state, status.read_number("residual"), status.read_number("nonsense")) == (
        "fem",
        None,
        None,
    )
    assert NodeStatus("camera", NodeLevel.WELL, "waits").state == "waits"


def test_a_problem_is_remembered_after_the_node_is_well_again():
    board = StatusBoard()
    board.add_report(NodeStatus("a", NodeLevel.WARNING, "the probe is lost"), now=1.0)
    board.add_report(NodeStatus("a", NodeLevel.WELL, "tracked"), now=2.0)
    (status,) = board.list_nodes(now=2.5)
    assert (status.level, status.message) == (NodeLevel.WELL, "tracked")
    assert (status.problem, status.problem_heard) == ("the probe is lost", 1.0)


def test_a_silent_node_is_gone_and_later_forgotten():
    board = StatusBoard()
    board.add_report(said("b"), now=0.0)
    board.add_report(said("a"), now=2.0)
    assert [s.name for s in board.list_nodes(now=2.9)] == ["a", "b"]
    assert [s.level for s in board.list_nodes(now=3.1)] == [NodeLevel.WELL, NodeLevel.GONE]
    assert board.find_node("b", now=3.1).read_number("rate_hz") is None
    assert [s.name for s in board.list_nodes(now=60.5)] == ["a"]
    assert board.find_node("c", now=3.0) is None


def test_nobody_is_silent_who_was_not_listened_to():
    board = StatusBoard()
    board.add_page()
    begun = time.monotonic()
    board.add_report(said("a"), now=begun - 2 * GONE_S)
    assert [s.level for s in board.list_nodes(begun + 0.5)] == [NodeLevel.WELL]
    assert [s.level for s in board.list_nodes(begun + GONE_S + 0.5)] == [NodeLevel.GONE]
    board.add_page()  # another page, which changes nothing
    assert [s.level for s in board.list_nodes(begun + GONE_S + 0.5)] == [NodeLevel.GONE]


def test_only_the_first_who_looks_and_the_last_who_goes_are_told():
    told: list[bool] = []
    board = StatusBoard(lambda: told.append(board.is_watched))
    board.add_page()
    board.add_page()
    board.remove_page()
    board.remove_page()
    assert told == [True, False]


def test_nodes_are_heard_while_somebody_looks(bench):
    listening = bench.add(GuardedNode("viewer", context=bench.context))
    listener = StatusListener(listening, CallPoster(listening))
    board = listener
    node = bench.add(GuardedNode("tissue_deformer", context=bench.context))
    node.health = Health(node, "arm")
    bench.spin_for(5)
    assert bench.peer.count_subscribers("diagnostics") == 0
    board.add_page()
    bench.spin_until(lambda: bench.peer.count_subscribers("diagnostics") == 1)
    node.health.state = "fem"

    def heard():
        node.health.publish_report()
        return any(
            s.name == "tissue_deformer" and s.state == "fem" for s in board.list_nodes(now())
        )

    bench.spin_until(heard)
    assert board.find_node("tissue_deformer", now()).level is NodeLevel.WELL
    node.health.count_problem("pose", "the pose is nonsense")

    def warned():
        node.health.publish_report()
        return board.find_node("tissue_deformer", now()).problem == "the pose is nonsense"

    bench.spin_until(warned)
    foreign = bench.peer.create_publisher(DiagnosticArray, "diagnostics", 10)
    status = DiagnosticStatus(name="camera: lens", level=DiagnosticStatus.ERROR, message="dirty")
    bench.spin_until(lambda: foreign.get_subscription_count() == 1)
    foreign.publish(DiagnosticArray(status=[status]))
    bench.spin_until(lambda: board.find_node("camera: lens", now()) is not None)
    assert board.find_node("camera: lens", now()).level is NodeLevel.ERROR

    board.remove_page()
    bench.spin_until(lambda: bench.peer.count_subscribers("diagnostics") == 0)
