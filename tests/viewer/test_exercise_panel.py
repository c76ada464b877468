"""The panel of an exercise: what a page shows of the score, and what it asks for."""

import base64
import json
from pathlib import Path

import pytest
from awaiting import until
from bench import Bench
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import String

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.qos import LATCHED
from us_sim.viewer.remote_parameters import make_answer
from us_sim.viewer.score import PICTURE, SCORE, connect_scorer
from us_sim.viewer.session import SessionBoard, SessionState
from us_sim.viewer.stream import CallPoster, Feed, Packet, PageSources

STEPS = (
    {"what": "vein at 9 mm", "state": "done", "seen": "closed at 6.0 N"},
    {"what": "vein at <b>29 mm", "state": "to do", "seen": "not reached"},
)
PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


class Scorer:
    """The streams of a score, and what pages ask of it: it draws at once."""

    def __init__(self, sources):
        self.score, self.picture = Feed(SCORE, rate=None), Feed(PICTURE, rate=None)
        sources.add_feeds(self.score, self.picture)
        sources.ask_scorer = self._take
        self.asked = []

    def _take(self, what):
        self.asked.append(what)
        if what == "draw":
            self.picture.offer_packet(lambda n: Packet(PICTURE, n, {}, PNG))

    def say(self, steps, feedback="live", changed="", state=""):
        header = {"name": "Compression", "description": "Compress the vein.", "scene": "arm"}
        header |= {"metrics": {"Path Length, mm": "60"}, "steps": list(steps), "faults": []}
        is_done = all(step["state"] == "done" for step in header["steps"])
        state = state or ("passed" if is_done else "running")
        header |= {"state": state, "plain": {"Time, s": "12"}}
        header |= {"about": {"begun": "now", "feedback": feedback, "changed": changed}}
        self.score.offer_packet(lambda n: Packet(SCORE, n, header, b""))


def open_panel(page, scorer, query=""):
    page.goto(f"{page.address}{query}")
    page.locator("#us-panels").click()
    page.get_by_role("tab", name="Exercise").click()
    until(lambda: scorer.picture.is_watched, "the panel is seen")


def test_task_steps_and_score_are_shown_begun_anew_and_saved(page, sources):
    scorer = Scorer(sources)
    open_panel(page, scorer)
    page.get_by_text("No exercise is followed: choose one.").wait_for()
    scorer.say(STEPS)
    page.get_by_text("To do: vein at <b>29 mm, not reached").wait_for()
    page.get_by_text("Done: vein at 9 mm, closed at 6.0 N").wait_for()
    page.get_by_text("goes on: 1 of 2 done, 12 s", exact=True).wait_for()
    scorer.say(
        STEPS, changed="slice_interpolator.gain = 3.0 at 7 s; tissue_deformer.solver = a at 9 s"
    )
    page.get_by_text("Changed, and told in the result: gain, solver").wait_for()
    page.get_by_text("More", exact=True).click()
    page.get_by_text("Path Length, mm").wait_for()
    page.get_by_role("button", name="Begin anew").click()
    page.get_by_role("dialog").get_by_role("button", name="Begin anew").click()
    until(lambda: scorer.asked == ["clear"], "it is asked for")
    scorer.say({**step, "state": "done"} for step in STEPS)
    page.get_by_text("passed: 2 of 2 done, 12 s", exact=True).wait_for()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save the result").click()
    kept = Path(download.value.path()).read_text()
    assert base64.b64encode(PNG).decode() in kept
    assert "<td>vein at &lt;b&gt;29 mm</td>" in kept
    assert "<td>Path Length, mm</td><td>60</td>" in kept
    page.get_by_role("img", name="The probe's way over the skin").wait_for()
    page.get_by_role("tab", name="Image").click()
    until(lambda: not scorer.picture.is_watched, "another tab is chosen")


def test_a_blind_exercise_hides_the_truth_and_asks(page, sources):
    scorer, asked = Scorer(sources), []

    async def answer(name, value):
        asked.append((name, value))
        return ""

    sources.nodes.get_node("scorer").set_value = answer
    steps = [{**STEPS[1], "what": what} for what in ("point 1", "point 2", "thrombus")]
    open_panel(page, scorer)
    scorer.say(steps, feedback="afterwards")
    page.get_by_role("button", name="Show the result").wait_for(state="hidden")
    button = page.get_by_role("button", name="point 1: not compressible")
    pressed = button.element_handle()
    scorer.say([{**step, "seen": "pressed with 3 N"} for step in steps], feedback="afterwards")
    page.get_by_text("To do: point 1, pressed with 3 N").wait_for()
    pressed.click()  # it has not been drawn anew meanwhile
    page.get_by_role("button", name="point 2: compressible", exact=True).click()
    page.get_by_role("button", name="thrombus: at 1", exact=True).click()
    until(lambda: len(asked) == 3, "it is answered")
    both = ["not compressible", "compressible"]  # the scorer has not told of the first yet
    assert asked == [("answers", both[:1]), ("answers", both), ("thrombus", "1")]
    scorer.say(steps, feedback="afterwards")
    until(lambda: button.get_attribute("aria-pressed") == "true", "it is seen which was clicked")
    assert pressed.is_visible()
    page.get_by_role("tab", name="Tissue").wait_for(state="hidden")
    page.get_by_role("button", name="Outlines").wait_for(state="hidden")
    scorer.say([{**step, "state": "done"} for step in steps], feedback="afterwards")
    page.get_by_role("tab", name="Tissue").wait_for()
    page.get_by_role("button", name="Outlines").wait_for()


def test_to_begin_a_blind_exercise_anew_loads_another_arm(page, sources):
    """The arm of before is known: the scorer does not clear it, the exercise is drawn again."""
    asked = []

    def send(values):
        asked.append(values)
        return make_answer("")

    scorer, sources.session = Scorer(sources), SessionBoard(send=send)
    sources.session.state = SessionState(
        is_there=True, scene="arm", origin="exercise:examination#675"
    )
    open_panel(page, scorer)
    scorer.say(STEPS, feedback="afterwards")
    page.get_by_role("button", name="Begin anew").click()
    page.get_by_role("dialog").get_by_role("button", name="Begin anew").click()
    until(lambda: asked == [{"scene": "exercise:examination"}], "another arm is loaded")
    assert not scorer.asked


@pytest.mark.parametrize(
    ("state", "target", "hint"),
    [
        ("to lift", [], "Press Lift"),
        ("to do", [[0, 0, 0]], "Click a number to move the probe over that point"),
        ("running", [], "Drag down on the image to press harder"),
        ("running", [[0, 0, 0]] * 9, "Drag sideways on the image"),
        ("running", [[0, 0, 0]], "Then press Lift, and click the next number."),
        ("not passed", [], "Begin anew starts another attempt"),
    ],
)
def test_a_hint_is_of_the_moment_and_the_task(page, sources, state, target, hint):
    scorer = Scorer(sources)
    open_panel(page, scorer)
    scorer.say([{**STEPS[1], "target": target}], state=state)
    page.get_by_text(hint).wait_for()


def test_who_only_watches_answers_and_erases_nothing(page, sources):
    scorer = Scorer(sources)
    open_panel(page, scorer, "?watch")
    scorer.say(STEPS, feedback="afterwards")
    page.get_by_text("To do: vein at <b>29 mm, not reached").wait_for()
    assert not page.get_by_role("button", name="not compressible").count()
    page.get_by_role("button", name="Begin anew").wait_for(state="hidden")


@pytest.fixture
def heard(bench: Bench):
    """The sources that a node fills."""
    node = bench.add(GuardedNode("viewer", context=bench.context))
    sources = PageSources()
    connect_scorer(node, CallPoster(node), sources)
    return sources


def test_what_the_scorer_says_is_heard_while_a_page_shows_it(bench, heard):
    publisher = bench.peer.create_publisher(DiagnosticArray, "score", LATCHED)
    pictures = bench.peer.create_publisher(CompressedImage, "score/picture", LATCHED)
    first = DiagnosticStatus(name="Press", message="Press.", values=[KeyValue(key="a", value="1")])
    line = [[0.0, 0.01, 0.001 * k] for k in range(300)]
    target = KeyValue(key="target", value=json.dumps(line))
    wrong = [KeyValue(key="target", value=text) for text in ("[[1, 2]]", "{", '["a"]', "[1e999]")]
    steps = [
        DiagnosticStatus(
            name="5 N",
            hardware_id="step",
            level=DiagnosticStatus.ERROR,
            message="2 s",
            values=[target],
        ),
        *(
            DiagnosticStatus(hardware_id="step", level=DiagnosticStatus.WARN, values=[each])
            for each in wrong
        ),
    ]
    changed = "; ".join(f"slice_interpolator.gain = {k} at {k} s" for k in range(50))
    about = DiagnosticStatus(hardware_id="about", values=[KeyValue(key="changed", value=changed)])
    publisher.publish(DiagnosticArray(status=[first, *steps, about]))
    pictures.publish(CompressedImage(format="png", data=PNG))
    bench.spin_for(5)
    score, picture = heard.feeds[SCORE], heard.feeds[PICTURE]
    assert not score.sequence
    for feed in (score, picture):
        feed.add_watcher(lambda: None)
    bench.spin_until(lambda: score.sequence and picture.sequence)
    assert picture.get_newest().payload == PNG
    told = score.get_newest().header
    assert (told["name"], told["description"], told["metrics"]) == ("Press", "Press.", {"a": "1"})
    assert told["about"] == {"begun": "", "feedback": "live", "changed": changed}
    missed = {"what": "5 N", "state": "missed", "seen": "2 s", "target": line}
    assert told["steps"] == [missed, *[{"what": "", "state": "to do", "seen": ""}] * len(wrong)]
    publisher.publish(DiagnosticArray())
    bench.spin_until(lambda: score.sequence == 2)
    assert score.get_newest().header["name"] == ""


def test_a_frozen_image_is_marked_in_the_recording(bench, heard):
    marks = bench.collect(String, "session/marker")
    bench.spin_until(lambda: bench.peer.count_publishers("session/marker") > 0)
    for said in (True, "yes", True):
        assert heard.commands["frozen"](said, 1) is None
    bench.spin_until(lambda: len(marks) == 2)
    assert [mark.data for mark in marks] == ["frozen", "frozen"]
