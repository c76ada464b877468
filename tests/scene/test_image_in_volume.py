"""A path whose images show nothing of the volume is refused before any is made."""

import numpy as np
import pytest

from us_sim.command.main import main
from us_sim.errors import SceneError
from us_sim.geometry.pose import Pose
from us_sim.recording.path import write_path
from us_sim.recording.press_and_slide import press_and_slide
from us_sim.scene.placement import check_path_in_volume, part_inside
from us_sim.scene.reading import load_scene, parse_scene
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe
from us_sim.volume.files.writing import write_volume
from us_sim.volume.volume import Volume

PROBE = {"aperture": "40 mm", "depth": "40 mm", "image": [200, 200]}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "press.mcap"
    write_path(file, press_and_slide(rate=6.0), sidecar=False)
    return file


@pytest.fixture
def volume(tmp_path):
    """10 cm around the origin of the file's frame; the upper 7 were never scanned."""
    grid = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    grid[:3, 3] = -49e-3
    grey = np.full((50, 50, 50), 90, np.uint8)
    grey[:, :, :35] = 0
    made = Volume(grey, grid)
    write_volume(tmp_path / "body.nrrd", made)
    return made


def scene_at(folder, position, orientation=(0, 0, 0, 1), **more):
    pose = {"position": list(position), "orientation": list(orientation)}
    volume = {"file": "body.nrrd", "pose": pose}
    return parse_scene({"name": "body", "volume": volume, "probe": PROBE, **more}, folders=[folder])


@pytest.mark.parametrize(
    ("shift", "part"), [(0.0, 1.0), (20e-3, 0.5), (41e-3, 0.0), (-30e-3, 0.25)]
)
def test_the_part_inside_is_that_of_the_rectangle(shift, part):
    probe = LinearProbe(aperture=0.04, depth=0.04, columns=400, rows=400)
    grid = np.diag([1e3, 1e3, 1e3, 1.0])
    grid[:3, 3] = [19.5, 20, -0.5]  # x from -20 to 20 mm, z from 0 to 40 mm
    (found,) = part_inside(probe, [Pose([shift, 0, 0])], grid, (40, 40, 40))
    assert found == pytest.approx(part, abs=0.04)


def test_the_corners_that_no_beam_reaches_do_not_count():
    probe = ConvexProbe(
        radius=0.05, opening_angle=np.pi / 3, depth=0.1, columns=300, rows=300, lines=64
    )
    grid = np.diag([1e3, 1e3, 1e3, 1.0])
    grid[:3, 3] = [-30.5, 10, 100]  # all that is beyond x = 30 mm
    (found,) = part_inside(probe, [Pose()], grid, (500, 50, 500))
    angle, radius = np.meshgrid(
        np.linspace(-1, 1, 801) * np.pi / 6, np.linspace(0.05, 0.15, 801), indexing="ij"
    )
    part = (radius * (radius * np.sin(angle) > 0.03)).sum() / radius.sum()
    assert found == pytest.approx(part, abs=0.02)


def test_a_scene_whose_images_meet_the_volume_is_taken(tmp_path, path, volume):
    check_path_in_volume(scene_at(tmp_path, (0, 0, 0)), path, volume)


@pytest.mark.parametrize(
    ("position", "sentence"),
    [((0.2, 0, 0), "lies beside"), ((0, 0.1, 0), "lies beside"), ((0, 0, 0.02), "taken")],
)
def test_a_volume_beside_the_path_is_said_with_where_it_is(
    tmp_path, path, volume, position, sentence
):
    scene = scene_at(tmp_path, position)
    matrix = scene.volume.pose.pose.matrix @ volume.index_to_patient
    placed = Volume(volume.intensities, matrix)
    if sentence == "taken":
        check_path_in_volume(scene, path, placed)
        return
    with pytest.raises(SceneError, match=sentence) as refused:
        check_path_in_volume(scene, path, placed)
    assert "body.nrrd" in str(refused.value)
    assert "another file" in str(refused.value)


def test_a_path_through_what_was_never_scanned_is_black(tmp_path, path, volume):
    scene = scene_at(tmp_path, (0, 0, 0.04))
    placed = Volume(volume.intensities, scene.volume.pose.pose.matrix @ volume.index_to_patient)
    with pytest.raises(SceneError, match="is black in all images"):
        check_path_in_volume(scene, path, placed)  # 52 mm deep at most, and scanned from 60 mm on


def test_a_registration_moves_the_images(tmp_path, path, volume):
    away = {"registration": {"position": [0.3, 0, 0]}}
    with pytest.raises(SceneError, match="lies beside"):
        check_path_in_volume(scene_at(tmp_path, (0, 0, 0), tracker=away), path, volume)


def test_the_probes_own_poses_are_not_registered_again(tmp_path, path, volume):
    away = {"frame": "ndi", "registration": {"position": [0.3, 0, 0]}}
    check_path_in_volume(scene_at(tmp_path, (0, 0, 0), tracker=away), path, volume)


@pytest.mark.parametrize("command", ["run", "dry-run", "render", "demo"])
@pytest.mark.usefixtures("volume")
def test_the_commands_say_so_before_they_start(tmp_path, path, command, capsys):
    file = tmp_path / "body.yaml"
    file.write_text(
        f"name: body\nvolume: {{file: body.nrrd, pose: {{position: [0.3, 0, 0]}}}}\n"
        f"probe: {{aperture: 4 cm, depth: 4 cm}}\npath: {path.name}\n"
    )
    load_scene(file)
    words = {
        "run": ["run", str(file), "--path", str(path)],
        "dry-run": ["run", str(file), "--dry-run"],
        "render": ["render", str(file), "--out", str(tmp_path / "out")],
        "demo": ["demo", str(file), "--out", str(tmp_path / "out")],
    }
    assert main(words[command]) == 1
    said = capsys.readouterr()
    assert "lies beside all images along press.mcap" in said.err
    assert "Traceback" not in said.err
    assert not list((tmp_path / "out").glob("*")) if (tmp_path / "out").exists() else True
