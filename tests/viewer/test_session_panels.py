"""The panels of cases and of the session, in a browser: what they show, and what they ask for."""

import dataclasses
from concurrent.futures import Future

import pytest
from awaiting import until

from us_sim.scene.listing import ListedScene
from us_sim.viewer.session import SessionBoard, SessionState
from us_sim.viewer.stream import ONLY_WATCHES, Feed, Packet

RUNNING = SessionState(True, "running", "upper_arm", "/arm.yaml")


@pytest.fixture
def session(sources):
    """The session that pages see, and what they asked of it."""
    asked = []

    def ask(values):
        told = Future()
        told.set_result("there is no such file" if "nowhere.mcap" in values.values() else "")
        asked.append(dict(values))
        return told

    sources.session = SessionBoard(send=ask)
    sources.session.state = RUNNING
    return sources.session, asked


def opened(page, tab):
    """The drawer, at a tab."""
    page.goto(page.address)
    page.locator("#us-panels").click()
    page.get_by_role("tab", name=tab).click()


def test_a_case_is_loaded_and_a_recording_is_not_ended_unasked(page, session):
    board, asked = session
    board.scenes = (
        ListedScene("upper_arm", "/arm.yaml", description="An arm.", tracker="pose"),
        ListedScene("liver", "case:/liver", "case", region="abdomen"),
        ListedScene("sweep", "/sweep.yaml", problem="volume.file: is missing"),
    )
    opened(page, "Cases")
    page.get_by_role("button", name="Load again upper_arm").wait_for()  # what is read there
    page.get_by_role("button", name="Load liver").click()
    assert not page.get_by_text("sweep").count()  # it cannot be loaded
    until(lambda: asked == [{"scene": "case:/liver"}], "it is asked for", 30.0)
    board.state = dataclasses.replace(RUNNING, state="starting: 2 of 5 nodes", fraction=0.4)
    page.get_by_text("upper arm: starting: 2 of 5 nodes, 40 %").wait_for()
    until(
        page.get_by_role("button", name="Load liver").is_disabled,
        "nothing else can be loaded meanwhile",
        30.0,
    )
    board.state = dataclasses.replace(RUNNING, record="a.mcap")
    until(page.get_by_role("button", name="Load liver").is_enabled, "it can be loaded again", 30.0)
    page.get_by_role("button", name="Load liver").click()
    page.get_by_role("button", name="Go on").click()
    page.get_by_role("button", name="Load liver").click()
    page.get_by_role("dialog").get_by_role("button", name="Load").click()
    until(lambda: len(asked) == 2, "it is asked for once more", 30.0)


def test_who_only_watches_loads_and_records_nothing(page, session):
    board, asked = session
    board.scenes = (ListedScene("liver", "case:/liver", "case"),)
    page.goto(f"{page.address}?watch")
    page.locator("#us-panels").click()
    page.get_by_role("tab", name="Cases").click()
    load = page.get_by_role("button", name="Load liver")
    load.wait_for()
    assert load.is_disabled()
    assert load.get_attribute("title") == ONLY_WATCHES
    page.get_by_role("tab", name="Session").click()
    for name in ("Record", "Stop", "Play or pause", "End replay"):
        button = page.get_by_role("button", name=name, exact=True)
        button.wait_for()
        assert button.is_disabled()
        assert button.get_attribute("title") == ONLY_WATCHES
    for field in page.locator(".us-session input").all():
        assert field.is_disabled()
    assert asked == []


def test_an_exercise_is_not_ended_unasked(page, session, sources):
    board, asked = session
    board.scenes = (ListedScene("liver", "case:/liver", "case"),)
    step = {"what": "press", "seen": "", "state": "to do"}
    header = {"name": "compression", "description": "", "scene": "upper_arm", "metrics": {}}
    header |= {"state": "running", "plain": {}, "about": {}, "faults": []}
    sources.add_feeds(Feed("score"))
    sources.feeds["score"].offer_packet(
        lambda n: Packet("score", n, {**header, "steps": [step]}, b"")
    )
    page.goto(page.address)
    page.get_by_role("tab", name="Cases").click()  # the panel of the exercise has opened
    page.get_by_role("button", name="Load liver").click()
    page.get_by_text("Loading liver ends the attempt at compression.").wait_for()
    assert asked == []
    page.get_by_role("dialog").get_by_role("button", name="Load").click()
    until(lambda: asked == [{"scene": "case:/liver"}], "it is asked for", 30.0)


def test_a_session_is_recorded_and_replayed(page, session):
    board, asked = session
    board.bags = {"hand.mcap": "/bags/hand.mcap"}
    opened(page, "Session")
    file = page.get_by_label("file")
    until(lambda: file.input_value().startswith("session_"), "a name is proposed", 30.0)
    proposed = file.input_value()
    file.fill("nowhere.mcap")
    page.get_by_role("button", name="Record", exact=True).click()
    page.get_by_text("there is no such file").wait_for()
    board.state = dataclasses.replace(
        RUNNING, record="/home/a/mine.mcap", record_state="starting", record_room_bytes=9e9
    )
    page.get_by_text("starting: /home/a/mine.mcap", exact=True).wait_for()
    page.get_by_text("recorder starting: mine.mcap").wait_for()
    assert not page.get_by_text("recording to").is_visible()
    writing = dataclasses.replace(board.state, record_state="recording", record_room_bytes=0)
    board.state = writing
    page.get_by_text("recording to /home/a/mine.mcap").wait_for()
    page.get_by_text("recording mine.mcap").wait_for()
    note = "metadata.yaml in this folder belongs to another recording"
    assert not page.get_by_text(note).is_visible()
    board.state = dataclasses.replace(writing, record_note=f"{note}, so …")
    page.get_by_text(note).wait_for()
    until(lambda: file.input_value() == "mine.mcap", "the field names what is written", 30.0)
    page.get_by_role("button", name="Stop", exact=True).click()
    until(lambda: asked[-1] == {"record": ""}, "it is ended", 30.0)
    page.get_by_text("recorded to /home/a/mine.mcap").wait_for()
    board.state = RUNNING
    page.get_by_text(note).wait_for(state="hidden")
    until(lambda: file.input_value().startswith("session_"), "another is proposed", 30.0)
    assert file.input_value() >= proposed
    page.get_by_label("recording or path").click()
    page.get_by_role("option", name="hand.mcap").click()
    page.get_by_role("button", name="Play or pause").click()
    until(lambda: asked[-1].get("replay") == "/bags/hand.mcap", "it is played", 30.0)
    assert asked[-1]["replay_as"] == "path"
    board.state = dataclasses.replace(
        RUNNING, replay="/bags/hand.mcap", replay_state="playing", position=3.2, duration=12.0
    )
    page.get_by_text("3.2 of 12.0 s, playing").wait_for()
    count = len(asked)
    slider = page.get_by_role("slider", name="Time in the replay, s").bounding_box()
    page.mouse.move(slider["x"] + 0.5 * slider["width"], slider["y"] + 0.5 * slider["height"])
    page.mouse.down()
    board.state = dataclasses.replace(board.state, position=3.4)
    page.get_by_text("3.4 of 12.0 s, playing").wait_for()
    page.mouse.up()
    until(lambda: len(asked) > count, "the time is asked for", 30.0)
    assert asked[-1]["replay_time"] == pytest.approx(6.0, abs=0.5)
    page.get_by_role("button", name="Play or pause").click()
    until(lambda: asked[-1] == {"replay_paused": True}, "it is paused", 30.0)


def test_a_replay_that_starts_is_paused_when_it_is_ready(page, session):
    board, asked = session
    board.state = dataclasses.replace(RUNNING, replay="/a.mcap", replay_state="starting")
    opened(page, "Session")
    page.get_by_text("s, starting").wait_for()
    play = page.get_by_role("button", name="Play or pause")
    play.get_by_text("pause").wait_for()
    play.click()
    until(lambda: asked == [{"replay_paused": True}], "it is to be paused", 30.0)
    board.state = dataclasses.replace(board.state, replay_paused=True, replay_state="waiting")
    page.get_by_text("paused when it is ready").wait_for()
    play.get_by_text("play_arrow").wait_for()
    play.click()
    until(lambda: asked[-1] == {"replay_paused": False}, "it is to be played", 30.0)


@pytest.mark.parametrize("typed", ["/data/other.mcap", "hand.mcap"])
def test_a_path_or_a_name_that_is_typed_is_replayed_and_stays(page, session, typed):
    board, asked = session
    board.bags = {"hand.mcap": "/bags/hand.mcap", "hand.mcap.old": "/bags/old"}
    file = board.bags.get(typed, typed)
    opened(page, "Session")
    field = page.get_by_label("recording or path")
    field.fill(typed)
    field.press("Enter")
    board.bags = {**board.bags, "new.mcap": "/bags/new.mcap"}
    page.get_by_role("button", name="Play or pause").click()
    until(lambda: asked, "it is asked for", 30.0)
    assert asked[-1].get("replay") == file
    board.state = dataclasses.replace(RUNNING, replay=file, replay_state="playing")
    page.get_by_text("s, playing").wait_for()
    assert field.input_value() == typed
    page.get_by_role("button", name="Play or pause").click()
    until(lambda: asked[-1] == {"replay_paused": True}, "it is paused", 30.0)


@pytest.mark.parametrize(
    ("asked", "file"),
    [
        ({"record": "a.mcap"}, "/recordings/a.mcap"),
        ({"record": "/home/a.mcap"}, ""),
        ({"record": "../a.mcap"}, ""),
        ({"record": "~a.mcap"}, ""),
        ({"scene": "/arm.yaml", "volume": "/etc/passwd"}, ""),
        ({"replay": "/home/b.mcap"}, ""),
    ],
)
def test_pages_of_others_name_what_is_listed_and_record_to_one_folder(asked, file):
    for is_own in (True, False):
        sent = []
        board = SessionBoard(
            send=lambda v, s=sent: s.append(v), folder="/recordings", is_own=is_own
        )
        board.state = RUNNING
        told = board.ask_control(**asked)
        if is_own or file:
            assert sent
            assert not file or sent == [{"record": file}]
        else:
            assert not sent
            assert next(iter(asked.values())) in told.result() or "/etc/passwd" in told.result()
