"""Lockstep: an image for every pose, and the same bytes from the recording of a session alone."""

import csv
from dataclasses import replace

import cv2
import numpy as np
import pytest
from command import us_sim

from us_sim.command.main import main
from us_sim.environment.simulation import ScanSimulation
from us_sim.geometry.pose import Pose
from us_sim.recording.path import read_path
from us_sim.recording.reader import read_bag
from us_sim.scene.reading import load_scene
from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume

POSES = 90


@pytest.fixture(scope="module")
def first(played_scene, tmp_path_factory):
    """The folder of a session with a parameter that is not the scene's.

    What is known of its images is written beside them, which changes nothing in them.
    """
    out = tmp_path_factory.mktemp("first") / "out"
    options = ["--param", "tissue_deformer.solver=fem_nonlinear", "--truth", "--out", out]
    result = us_sim("render", played_scene, *options)
    assert result.returncode == 0, result.stderr
    return out


@pytest.fixture(scope="module")
def again(first, tmp_path_factory):
    """The folder of the same from a copy of its file alone, in a folder where nothing else is."""
    folder = tmp_path_factory.mktemp("again")
    alone = folder / "alone.mcap"
    alone.write_bytes((first / "session.mcap").read_bytes())
    assert us_sim("bag", "extract", alone, "--out", folder / "alone").returncode == 0
    options = ["--param", "tissue_deformer.solver=fem_nonlinear", "--out", folder / "out"]
    scene = folder / "alone" / "scene.yaml"
    result = us_sim("render", scene, "--path", alone, *options, cwd=folder)
    assert result.returncode == 0, result.stderr
    return folder / "out"


def payloads(folder):
    messages: dict[str, list[bytes]] = {}
    for message in read_bag(folder / "session.mcap").read_messages():
        messages.setdefault(message.topic, []).append(bytes(message.data))
    return messages


def test_images_are_identical_and_one_for_each_pose(first, again):
    one, other = (sorted((folder / "images").glob("*.png")) for folder in (first, again))
    assert len(one) == len(other) == POSES
    assert [file.name for file in one] == [file.name for file in other]
    for file, same in zip(one, other, strict=True):
        assert file.read_bytes() == same.read_bytes()
    assert len({file.read_bytes() for file in one}) > POSES // 3


def test_messages_are_identical(first, again):
    one, other = map(payloads, (first, again))
    assert one.keys() == other.keys()
    for latched in ("/tissue/rest", "/tissue/tetrahedra", "/skin/mesh"):
        assert len(one[latched]) == 1
    for topic in ("/tracker/pose", "/probe/pose", "/tissue/nodes", "/ultrasound/image"):
        assert len(one[topic]) == POSES, topic
    assert len(one["/skin/nodes"]) == POSES
    for topic in one:
        assert one[topic] == other[topic], topic


def test_the_same_poses_make_the_same_images_without_ros(first, played_scene):
    """But for the topics' 32 bits: a node is 2e-9 m off, and few pixels round otherwise."""
    scene = load_scene(played_scene)
    simulation = ScanSimulation(
        replace(scene, tissue=replace(scene.tissue, solver="fem_nonlinear"))
    )
    files = sorted((first / "images").glob("*.png"))
    path = read_path(first / "session.mcap", "/probe/pose")
    apart = []
    for file, position, orientation in zip(files, path.positions, path.orientations, strict=True):
        image = simulation.step(Pose(position, orientation)).image
        there = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        apart.append(np.abs(image.astype(int) - there).ravel())
    assert np.mean(np.array(apart) > 2) < 1e-4


def test_the_truth_of_each_image_lies_under_its_number(first, again):
    names = {int(n): name for n, name in list(csv.reader((first / "labels.csv").open()))[1:]}
    files = [sorted((first / what).iterdir()) for what in ("images", "labels", "displacement")]
    assert [len(each) for each in files] == [POSES] * 3
    assert [{file.stem for file in each} for each in files[1:]] == [{f.stem for f in files[0]}] * 2
    deepest = POSES // 2
    labels = cv2.imread(str(files[1][deepest]), cv2.IMREAD_UNCHANGED)
    found = {names[number] for number in np.unique(labels)}
    assert {"fat", "muscle"} <= found <= {"nothing", *names.values()}
    lifted, moved = (np.load(files[2][n]) for n in (0, deepest))
    assert (lifted.shape, lifted.dtype) == ((*labels.shape, 2), np.float32)
    assert np.nanmax(np.abs(lifted)) < 1e-6  # the probe is above the skin
    assert 0.004 < np.nanmax(moved[..., 1]) < 0.009  # pressed in by 7 mm
    assert not any((again / what).exists() for what in ("labels", "displacement"))


def test_where_nothing_is_known_of_images_that_is_said(tmp_path, short_path, capsys):
    plain = Volume(np.full((9, 9, 9), 40, np.uint8), np.diag([5e-3, 5e-3, 5e-3, 1.0]))
    write_volume(tmp_path / "plain.nrrd", plain)
    scene = tmp_path / "plain.yaml"
    probe = "{aperture: 40 mm, depth: 30 mm}"
    scene.write_text(f"name: plain\nvolume: {{file: plain.nrrd}}\nprobe: {probe}\n")
    options = ["--path", str(short_path), "--out", str(tmp_path / "out"), "--truth"]
    assert main(["render", str(scene), *options]) == 1
    assert "has neither a volume with labels nor tissue" in capsys.readouterr().err


def test_an_output_folder_in_use_is_refused(first, played_scene, capsys):
    assert main(["render", str(played_scene), "--out", str(first)]) == 1
    assert "is not empty; choose another folder" in capsys.readouterr().err


def test_areas_are_those_at_rest_before_the_probe_presses(first, tmp_path):
    session = str(first / "session.mcap")
    assert main(["bag", "extract", session, "--areas", "--out", str(tmp_path)]) == 0
    with (tmp_path / "areas.csv").open(encoding="utf-8") as stream:
        rows = [
            {name: float(value or "nan") for name, value in r.items()}
            for r in csv.DictReader(stream)
        ]
    assert rows[0]["vein_mm2"] == rows[0]["vein_at_rest_mm2"] > 5.0
    deepest = max(rows, key=lambda row: row["depth_mm"])
    assert deepest["depth_mm"] == pytest.approx(7.0, abs=0.1)
    assert deepest["vein_mm2"] < 0.8 * deepest["vein_at_rest_mm2"]


def test_a_live_session_gives_an_image_for_every_pose_that_came(demo, tmp_path):
    session, scene = demo / "session.mcap", tmp_path / "alone" / "scene.yaml"
    assert us_sim("bag", "extract", session, "--out", scene.parent).returncode == 0
    result = us_sim("render", scene, "--path", session, "--out", tmp_path / "again")
    assert result.returncode == 0, result.stderr
    live, made = payloads(demo), payloads(tmp_path / "again")
    assert live["/tracker/pose"] == made["/tracker/pose"]
    assert set(live["/probe/pose"]) <= set(made["/probe/pose"])  # some were passed over, live
    assert len(made["/ultrasound/image"]) == len(made["/probe/pose"])
    stamps = {image[4:12] for image in made["/ultrasound/image"]}
    assert stamps >= {image[4:12] for image in live["/ultrasound/image"]}
