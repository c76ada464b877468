"""What pages know of nodes: newest status, problems, silence, and bounded histories."""

import time

import pytest

from us_sim.viewer.status import GONE_S, Level, NodeStatus, StatusBoard

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


def said(name: str = "tissue_deformer", level: Level = Level.WELL, **values: str) -> NodeStatus:
    return NodeStatus(name, level, "fem", VALUES | values)


def test_the_numbers_that_a_node_says_are_read():
    status = said()
    assert (status.rate, status.received, status.dropped, status.problems) == (59.5, 120, 4, 6)
    assert (status.state, status.number("residual"), status.number("nonsense")) == (
        "fem",
        None,
        None,
    )
    assert NodeStatus("camera", Level.WELL, "waits").state == "waits"


def test_a_problem_is_remembered_after_the_node_is_well_again():
    board = StatusBoard()
    board.tell(NodeStatus("a", Level.WARNING, "the probe is lost"), now=1.0)
    board.tell(NodeStatus("a", Level.WELL, "tracked"), now=2.0)
    (status,) = board.nodes(now=2.5)
    assert (status.level, status.message) == (Level.WELL, "tracked")
    assert (status.problem, status.problem_heard) == ("the probe is lost", 1.0)


def test_a_silent_node_is_gone_and_later_forgotten():
    board = StatusBoard()
    board.tell(said("b"), now=0.0)
    board.tell(said("a"), now=2.0)
    assert [s.name for s in board.nodes(now=2.9)] == ["a", "b"]
    assert [s.level for s in board.nodes(now=3.1)] == [Level.WELL, Level.GONE]
    assert board.node("b", now=3.1).rate is None
    assert [s.name for s in board.nodes(now=60.5)] == ["a"]
    assert board.node("c", now=3.0) is None


def test_nobody_is_silent_who_was_not_listened_to():
    board = StatusBoard()
    board.watch(pages=1)
    begun = time.monotonic()
    board.tell(said("a"), now=begun - 2 * GONE_S)
    assert [s.level for s in board.nodes(begun + 0.5)] == [Level.WELL]
    assert [s.level for s in board.nodes(begun + GONE_S + 0.5)] == [Level.GONE]
    board.watch(pages=1)  # another page, which changes nothing
    assert [s.level for s in board.nodes(begun + GONE_S + 0.5)] == [Level.GONE]


def test_histories_are_of_the_numbers_that_are_plotted_and_bounded():
    board = StatusBoard()
    for second in range(300):
        board.tell(said(rate_hz=str(second)), now=float(second))
    history = board.history("rate_hz", since=240.0)["tissue_deformer"]
    assert history == [(float(s), float(s)) for s in range(241, 300)]
    assert len(board.history("rate_hz", since=0.0)["tissue_deformer"]) == 100
    assert board.history("residual", since=0.0) == {}
    assert board.history("received", since=0.0) == {}


def test_of_the_forces_within_a_tenth_of_a_second_the_largest_is_kept():
    board = StatusBoard()
    for i in range(120):  # 60 a second, for 2 s
        board.feel(float(i % 6), now=i / 60)
    forces = board.forces(since=-1.0)
    assert 18 <= len(forces) <= 20
    assert {force for _, force in forces[:-1]} == {5.0}
    assert board.forces(since=1.0) == [each for each in forces if each[0] > 1.0]
    for i in range(10_000):
        board.feel(1.0, now=10.0 + i)
    assert len(board.forces(since=0.0)) == 600


def test_only_the_first_who_looks_and_the_last_who_goes_are_told():
    told: list[tuple[bool, bool]] = []
    board = StatusBoard(lambda: told.append((board.is_watched, board.is_force_watched)))
    for pages, plots in [(1, 0), (1, 0), (0, 1), (-1, 0), (0, -1), (-1, 0)]:
        board.watch(pages, plots)
    assert told == [(True, False), (True, True), (True, False), (False, False)]


@pytest.mark.parametrize("level", [Level.WARNING, Level.ERROR])
def test_what_is_wrong_has_its_level(level):
    board = StatusBoard()
    board.tell(said(level=level), now=0.0)
    assert board.node("tissue_deformer", now=1.0).level is level
