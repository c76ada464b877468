"""The losses of a run, in a sentence and in the summary."""

import pytest

from us_sim.recording.writer import BagWriter
from us_sim.run.losses import Loss, Outcome, files_of, images_in


def outcome(losses=(), files=(), **counts):
    counts = {"made": 600, "recorded": 600, "poses": 600} | counts
    return Outcome(1.0, list(losses), list(files), **counts)


@pytest.fixture
def files(tmp_path):
    return [tmp_path / "session.mcap", tmp_path / "session_1.mcap"]


def test_nothing_lost_is_nothing_said(files):
    assert outcome().sentence() == ""
    assert outcome(files=files[:1]).sentence() == ""
    # Poses that a live simulation skips are no loss of the recording's.
    assert outcome(files=files[:1], made=590, recorded=591).sentence() == ""
    assert outcome(made=590, recorded=0).sentence() == ""  # nothing was recorded


def test_images_that_are_not_in_the_recording_are_said(files):
    lacking = outcome(files=files[:1], recorded=64, made=440, poses=None)
    assert lacking.sentence() == (
        "64 images were recorded of 440 that were made; the recording is in session.mcap"
    )


def test_the_summary_has_all_of_it(files):
    loss = Loss("a", "ended with status 3", 1.23, last_words="out of memory", back_after_s=2.0)
    told = outcome([loss], files, recorded=590).summary()
    assert told["images_made"] == 600
    assert told["images_recorded"] == 590
    assert told["files"] == ["session.mcap", "session_1.mcap"]
    (node,) = told["nodes"]
    assert node.pop("time")[:2] == "20"
    assert node == {
        "node": "a",
        "what": "ended with status 3",
        "at_s": 1.23,
        "last_words": "out of memory",
        "back_after_s": 2.0,
        "given_up": "",
    }


def test_the_files_of_a_recording_are_found_in_their_order(tmp_path):
    names = ["a.mcap", "a_1.mcap", "a_2.mcap", "a_2_1.mcap", "a_10.mcap"]
    for name in (*names, "ab.mcap", "a_b.mcap", "a_1.db3", "b_1.mcap"):
        (tmp_path / name).touch()
    assert [file.name for file in files_of(tmp_path / "a.mcap")] == names
    assert files_of(tmp_path / "none.mcap") == []


def test_images_are_counted_in_all_files_and_a_broken_one_has_none(files, tmp_path):
    for count, file in enumerate(files, start=3):
        with BagWriter(file, sidecar=False) as writer:
            writer.add_topic("/ultrasound/image", "std_msgs/msg/Empty")
            for stamp in range(count):
                writer.write("/ultrasound/image", bytes(5), stamp)
    empty = tmp_path / "empty.mcap"
    empty.touch()
    assert images_in([*files, empty]) == 3 + 4
