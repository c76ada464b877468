"""A session simulated again from its recording alone: the same bytes."""

from csv import DictReader

import pytest
from command import us_sim

from us_sim.recording.reader import read_bag


def payloads(file):
    messages: dict[str, list[bytes]] = {}
    for message in read_bag(file).messages():
        messages.setdefault(message.topic, []).append(message.data)
    return messages


@pytest.fixture(scope="module")
def first(played_scene, tmp_path_factory):
    """The folder of a session with a parameter that is not the scene's."""
    out = tmp_path_factory.mktemp("first") / "out"
    options = ["--param", "tissue_deformer.solver=fem", "--out", out]
    result = us_sim("render", played_scene, *options)
    assert result.returncode == 0, result.stderr
    return out


def test_a_session_gives_its_own_bytes_again(first, tmp_path):
    """Also from a copy of the file alone, in a folder where nothing else is."""
    alone = tmp_path / "alone.mcap"
    alone.write_bytes((first / "session.mcap").read_bytes())
    result = us_sim("render", "--session", alone, "--out", tmp_path / "again", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "images may differ" not in result.stderr
    assert "pairs are equal" in result.stdout
    one, other = payloads(alone), payloads(tmp_path / "again" / "session.mcap")
    assert one.keys() == other.keys()
    for topic in one:
        assert one[topic] == other[topic], topic
    for image in (first / "images").iterdir():
        assert image.read_bytes() == (tmp_path / "again" / "images" / image.name).read_bytes()


def test_areas_are_those_at_rest_before_the_probe_presses(first, tmp_path):
    result = us_sim("bag", "extract", first / "session.mcap", "--areas", "--out", tmp_path)
    assert result.returncode == 0, result.stderr
    with (tmp_path / "areas.csv").open(encoding="utf-8") as stream:
        rows = [
            {name: float(value or "nan") for name, value in r.items()} for r in DictReader(stream)
        ]
    assert rows[0]["vein_mm2"] == rows[0]["vein_at_rest_mm2"] > 5.0
    deepest = max(rows, key=lambda row: row["depth_mm"])
    assert deepest["depth_mm"] == pytest.approx(7.0, abs=0.1)
    assert deepest["vein_mm2"] < 0.8 * deepest["vein_at_rest_mm2"]


def test_a_live_session_gives_an_image_for_every_pose_that_came(demo, tmp_path):
    result = us_sim("render", "--session", demo / "session.mcap", "--out", tmp_path / "again")
    assert result.returncode == 0, result.stderr
    live, again = payloads(demo / "session.mcap"), payloads(tmp_path / "again" / "session.mcap")
    assert live["/tracker/pose"] == again["/tracker/pose"]
    assert set(live["/probe/pose"]) <= set(again["/probe/pose"])  # some were passed over, live
    assert len(again["/ultrasound/image"]) == len(again["/probe/pose"])
    stamps = {image[4:12] for image in again["/ultrasound/image"]}
    assert stamps >= {image[4:12] for image in live["/ultrasound/image"]}


def test_a_parameter_that_is_given_counts(first, tmp_path):
    out = tmp_path / "other"
    options = ["--param", "tissue_deformer.solver=msds_implicit", "--out", out]
    result = us_sim("render", "--session", first / "session.mcap", *options)
    assert result.returncode == 0, result.stderr
    one, other = payloads(first / "session.mcap"), payloads(out / "session.mcap")
    assert one["/probe/pose"] == other["/probe/pose"]
    assert one["/tissue/nodes"] != other["/tissue/nodes"]
    files = first / "session.mcap", out / "session.mcap"
    result = us_sim("bag", "diff", *files)
    assert result.returncode == 1, result.stderr
    rows = {line.split("  ")[0]: line for line in result.stdout.splitlines()}
    assert "90    90" in rows["/probe/pose"]
    assert "vein (mm²)" in rows["areas of vessels"]
    assert us_sim("bag", "diff", files[0], files[0]).returncode == 0
