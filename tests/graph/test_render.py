"""Lockstep: one image for every pose, and the same bytes on every run."""

import pytest
from command import us_sim

from us_sim.recording.reader import read_bag

POSES = 90


@pytest.fixture(scope="module")
def two_runs(played_scene, tmp_path_factory):
    folders = [tmp_path_factory.mktemp("render") / "out" for _ in range(2)]
    for folder in folders:
        result = us_sim("render", played_scene, "--out", folder)
        assert result.returncode == 0, result.stderr
    return folders


def payloads(folder):
    messages: dict[str, list[bytes]] = {}
    for message in read_bag(folder / "session.mcap").messages():
        messages.setdefault(message.topic, []).append(bytes(message.data))
    return messages


def test_images_are_identical_and_one_for_each_pose(two_runs):
    first, second = (sorted((folder / "images").glob("*.png")) for folder in two_runs)
    assert len(first) == len(second) == POSES
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert len({file.read_bytes() for file in first}) > POSES // 3


def test_messages_are_identical(two_runs):
    first, second = map(payloads, two_runs)
    assert first.keys() == second.keys()
    for latched in ("/tissue/rest", "/tissue/tetrahedra", "/skin/mesh"):
        assert len(first[latched]) == 1
    for topic in ("/tracker/pose", "/probe/pose", "/tissue/nodes", "/ultrasound/image"):
        assert len(first[topic]) == POSES, topic
    assert len(first["/skin/nodes"]) == POSES
    for topic in first:
        assert first[topic] == second[topic], topic


def test_an_output_folder_in_use_is_refused(two_runs, played_scene):
    result = us_sim("render", played_scene, "--out", two_runs[0])
    assert result.returncode == 1
    assert "is not empty; choose another folder" in result.stderr
