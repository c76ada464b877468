"""The demo tracked by a camera: a rendered video of the path through the whole graph."""

import json

import pytest
from command import us_sim
from mcap.reader import make_reader

from us_sim.command.main import main
from us_sim.share import shared_path

IMAGES = 45  # of 90 poses, 60 a second: 1.48 s at 30 images a second


@pytest.fixture(scope="module")
def camera_scene(played_scene):
    file = played_scene.with_name("camera.yaml")
    text = shared_path("config/scenes/upper_arm_camera.yaml").read_text()
    markers = shared_path("config/markers/probe_grip.yaml")
    text = text.replace("based_on: upper_arm", f"based_on: {played_scene}")
    file.write_text(text.replace("../markers/probe_grip.yaml", str(markers)))
    return file


@pytest.fixture(scope="module")
def demo(camera_scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("camera_demo") / "out"
    result = us_sim("demo", camera_scene, "--source", "camera", "--out", out)
    assert result.returncode == 0, result.stderr
    return out, result.stdout


def test_the_tracked_path_is_near_the_true_one(demo):
    out, said = demo
    summary = json.loads((out / "summary.json").read_text())
    tracked = summary["tracked_path"]
    assert tracked["images"] == IMAGES
    # A loaded machine may skip images, never show a wrong one.
    assert IMAGES / 2 < tracked["tracked"] <= tracked["shown"] <= IMAGES
    assert tracked["error_mm"]["median"] < 0.3
    assert tracked["error_mm"]["p95"] < 1.0
    assert tracked["error_deg"]["median"] < 0.2
    assert tracked["error_deg"]["p95"] < 0.6
    assert f"tracked in {tracked['tracked']} of {IMAGES} images, from the true path" in said
    assert f"{tracked['error_mm']['median']:.3f} mm" in said


def test_the_recording_has_the_camera_but_not_its_images(demo):
    with (demo[0] / "session.mcap").open("rb") as file:
        names = {channel.topic for channel in make_reader(file).get_summary().channels.values()}
    assert "/camera/camera_info" in names
    assert not {"/camera/image_raw", "/tracker/pose"} & names


def test_a_scene_without_a_camera_is_refused(played_scene, tmp_path, capsys):
    out = str(tmp_path / "out")
    assert main(["demo", str(played_scene), "--source", "camera", "--out", out]) == 1
    said = capsys.readouterr().err
    assert "the tracker of" in said
    assert "name a scene whose tracker is a camera" in said


def test_a_camera_that_looks_elsewhere_is_refused(camera_scene, tmp_path, capsys):
    away = tmp_path / "away.yaml"
    away.write_text(
        f"name: away\nbased_on: {camera_scene}\n"
        "tracker: {registration: {position: [0, 0, 1], orientation: [0, 0, 0, 1]}}\n"
    )
    assert main(["demo", str(away), "--source", "camera", "--out", str(tmp_path / "out")]) == 1
    assert "the camera does not see the markers on the path" in capsys.readouterr().err
