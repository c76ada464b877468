"""The panel of an exercise: what a page shows of the score, and what it asks for."""

import pytest
from awaiting import until
from bench import Bench
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import String

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.qos import LATCHED
from us_sim.viewer.score import ScoreBoard, ScoreListener, ToldScore, ToldStep
from us_sim.viewer.stream import Simulator

STEPS = (
    ToldStep("vein at 9 mm", True, "closed at 6.0 N"),
    ToldStep("vein at 29 mm", False, "missed"),
)


def test_task_steps_and_score_are_shown_and_begun_anew(page, simulator):
    asked = []
    simulator.score = ScoreBoard(clear=lambda: asked.append(True))
    page.goto(page.address)
    page.locator("#us-panels").click()
    page.get_by_role("tab", name="Exercise").click()
    page.get_by_text("No exercise is followed").wait_for()
    until(lambda: simulator.score.is_watched, "the panel is seen")
    metrics = {"Path Length, mm": "60"}
    simulator.score.score = ToldScore("Compression", "Compress the vein.", metrics, STEPS)
    page.get_by_text("To do: vein at 29 mm, missed").wait_for()
    page.get_by_text("Done: vein at 9 mm, closed at 6.0 N").wait_for()
    page.get_by_text("1 of 2 done", exact=True).wait_for()
    page.get_by_text("Score so far").click()
    page.get_by_text("Path Length, mm").wait_for()
    page.get_by_role("button", name="Begin anew").click()
    until(lambda: asked == [True], "it is asked for")
    done = tuple(step._replace(is_done=True) for step in STEPS)
    simulator.score.score = ToldScore("Compression", "Compress the vein.", metrics, done)
    page.get_by_text("passed: 2 of 2 done").wait_for()
    page.get_by_role("tab", name="Image").click()
    until(lambda: not simulator.score.is_watched, "another tab is chosen")


@pytest.fixture
def heard(bench: Bench):
    """A listener on its node, and the simulator that it obeys."""
    node = bench.add(GuardedNode("viewer", context=bench.context))
    simulator = Simulator(score=ScoreListener(node, lambda work: work()))
    simulator.score.take_commands(simulator)
    return simulator


def test_what_the_scorer_says_is_heard_while_a_page_shows_it(bench, heard):
    publisher = bench.peer.create_publisher(DiagnosticArray, "score", LATCHED)
    first = DiagnosticStatus(name="Press", message="Press.", values=[KeyValue(key="a", value="1")])
    step = DiagnosticStatus(name="5 N", level=DiagnosticStatus.WARN, message="2.0 s")
    publisher.publish(DiagnosticArray(status=[first, step]))
    bench.spin_for(5)
    assert heard.score.score == ToldScore()
    heard.score.watch()
    bench.spin_until(lambda: heard.score.score.name == "Press")
    expected = ToldScore("Press", "Press.", {"a": "1"}, (ToldStep("5 N", False, "2.0 s"),))
    assert heard.score.score == expected
    publisher.publish(DiagnosticArray())
    bench.spin_until(lambda: heard.score.score == ToldScore())


def test_a_frozen_image_is_marked_in_the_recording(bench, heard):
    marks = bench.collect(String, "session/marker")
    bench.spin_until(lambda: bench.peer.count_publishers("session/marker") > 0)
    for said in (True, "yes", True):
        assert heard.commands["frozen"](said, 1) is None
    bench.spin_until(lambda: len(marks) == 2)
    assert [mark.data for mark in marks] == ["frozen", "frozen"]
