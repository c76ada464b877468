"""Lockstep: one image for every pose, and the same bytes on every run."""

import csv

import cv2
import numpy as np
import pytest
from command import us_sim

from us_sim.environment.simulation import Simulation
from us_sim.geometry.pose import Pose
from us_sim.recording.path import read_path
from us_sim.recording.reader import read_bag
from us_sim.scene.reading import load_scene
from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume

POSES = 90


@pytest.fixture(scope="module")
def two_runs(played_scene, tmp_path_factory):
    """The second with all that is known of its images, which changes nothing in them."""
    folders = [tmp_path_factory.mktemp("render") / "out" for _ in range(2)]
    for folder, options in zip(folders, ([], ["--truth"]), strict=True):
        result = us_sim("render", played_scene, "--out", folder, *options)
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


def test_the_same_poses_make_the_same_images_without_ros(two_runs, played_scene):
    """But for the topics' 32 bits: a node is 2e-9 m off, and few pixels round otherwise."""
    simulation = Simulation(load_scene(played_scene))
    files = sorted((two_runs[0] / "images").glob("*.png"))
    path = read_path(two_runs[0] / "session.mcap", "/probe/pose")
    apart = []
    for file, position, orientation in zip(files, path.positions, path.orientations, strict=True):
        image = simulation.step(Pose(position, orientation)).image
        there = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        apart.append(np.abs(image.astype(int) - there).ravel())
    assert np.mean(np.array(apart) > 2) < 1e-4


def test_the_truth_of_each_image_lies_under_its_number(two_runs):
    out = two_runs[1]
    names = {int(n): name for n, name in list(csv.reader((out / "labels.csv").open()))[1:]}
    files = [sorted((out / what).iterdir()) for what in ("images", "labels", "displacement")]
    assert [len(each) for each in files] == [POSES] * 3
    assert [{file.stem for file in each} for each in files[1:]] == [{f.stem for f in files[0]}] * 2
    deepest = POSES // 2
    labels = cv2.imread(str(files[1][deepest]), cv2.IMREAD_UNCHANGED)
    found = {names[number] for number in np.unique(labels)}
    assert {"fat", "muscle"} <= found <= {"nothing", *names.values()}
    first, moved = (np.load(files[2][n]) for n in (0, deepest))
    assert (first.shape, first.dtype) == ((*labels.shape, 2), np.float32)
    assert np.nanmax(np.abs(first)) < 1e-6  # the probe is above the skin
    assert 0.004 < np.nanmax(moved[..., 1]) < 0.009  # pressed in by 7 mm
    assert not any((two_runs[0] / what).exists() for what in ("labels", "displacement"))


def test_where_nothing_is_known_of_images_that_is_said(tmp_path, short_path):
    plain = Volume(np.full((9, 9, 9), 40, np.uint8), np.diag([5e-3, 5e-3, 5e-3, 1.0]))
    write_volume(tmp_path / "plain.nrrd", plain)
    scene = tmp_path / "plain.yaml"
    probe = "{aperture: 40 mm, depth: 30 mm}"
    scene.write_text(f"name: plain\nvolume: {{file: plain.nrrd}}\nprobe: {probe}\n")
    out = tmp_path / "out"
    result = us_sim("render", scene, "--path", short_path, "--out", out, "--truth")
    assert result.returncode == 1
    assert "has neither a volume with labels nor tissue" in result.stderr


def test_an_output_folder_in_use_is_refused(two_runs, played_scene):
    result = us_sim("render", played_scene, "--out", two_runs[0])
    assert result.returncode == 1
    assert "is not empty; choose another folder" in result.stderr
