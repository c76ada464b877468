"""A pressed sweep, reconstructed as it was seen and as it lies at rest.

A path whose images show nothing of the volume is refused before any is made.
"""

import dataclasses

import numpy as np
import pytest
from sweep_file import write_sweep

from us_sim.command.main import main
from us_sim.errors import SceneError
from us_sim.geometry.pose import Pose
from us_sim.recording.path import write_path
from us_sim.recording.press_and_slide import make_press_and_slide
from us_sim.scene.building import build_probe, build_tissue_model, load_volume
from us_sim.scene.placement import (
    build_rest_placement,
    check_path_in_volume,
    compute_part_inside,
    find_probe_pose,
)
from us_sim.scene.reading import load_scene, parse_scene
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe
from us_sim.tissue.solvers.solver import create_solver
from us_sim.volume.cases.case import read_case
from us_sim.volume.files.readers import read_volume
from us_sim.volume.files.writing import write_volume
from us_sim.volume.reconstruction.reconstruction import plan_insertion, reconstruct
from us_sim.volume.reconstruction.settings import Compounding, ImagePart
from us_sim.volume.sequences.sweep import read_sweep
from us_sim.volume.volume import Volume

PRESS = 0.006  # m
ACROSS = np.linspace(-0.012, 0.012, 25)  # m, of the probe along its elevation


@pytest.fixture(scope="module")
def pressed(small_scene, tmp_path_factory):
    """The scene, its volume, and a sweep of images that the pressing probe sees."""
    scene = load_scene(small_scene)
    volume, probe = load_volume(scene), build_probe(scene)
    model = build_tissue_model(scene, volume)
    solver = create_solver("fem", model)
    mesh = model.mesh
    slicer = create_slicer("scan_conversion", volume, mesh.nodes, mesh.tetrahedra)
    images, matrices = [], []
    for y in ACROSS:
        pose = Pose([0.0, float(y), PRESS])
        images.append(slicer.cut_image(solver.deform(pose).nodes, probe.make_plane(pose)))
        # Columns along the probe's x, rows along its z: the third step completes the frame.
        columns, rows = probe.image_to_probe[:3, 0], probe.image_to_probe[:3, 1]
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 3] = columns, rows, probe.image_to_probe[:3, 3]
        matrix[:3, 2] = np.cross(columns, rows) / np.linalg.norm(columns)
        matrices.append(pose.matrix @ matrix)
    file = tmp_path_factory.mktemp("pressed") / "pressed.igs.mha"
    return scene, volume, read_sweep(write_sweep(file, np.array(images), matrices))


def difference(made, volume):
    """The mean difference in grey levels from the volume at rest, where tissue was seen."""
    made_at = np.argwhere(made.covered & (made.volume.intensities > 0))
    placed = made.volume.index_to_patient
    points = made_at @ placed[:3, :3].T + placed[:3, 3]
    at = points @ volume.patient_to_index[:3, :3].T + volume.patient_to_index[:3, 3]
    at = np.round(at).astype(int)
    inside = ((at >= 0) & (at < volume.shape)).all(axis=1)
    rest = volume.intensities[tuple(at[inside].T)].astype(float)
    seen = made.volume.intensities[tuple(made_at[inside].T)]
    both = rest > 0
    return np.abs(rest - seen)[both].mean(), np.corrcoef(rest[both], seen[both])[0, 1]


def test_undoing_the_pressure_brings_the_tissue_back(pressed):
    scene, volume, sweep = pressed
    how = Compounding(spacing=volume_spacing(volume))
    as_seen = reconstruct(plan_insertion(sweep, how))
    rest = build_rest_placement(scene, sweep, ImagePart())
    at_rest = reconstruct(plan_insertion(sweep, how, rest=rest))
    seen, seen_correlation = difference(as_seen, volume)
    undone, undone_correlation = difference(at_rest, volume)
    # Measured: 26.1 and 18.7 grey levels, correlations of 0.29 and 0.76, most of it of speckle.
    assert undone < 0.75 * seen
    assert undone_correlation > 0.7 > 0.4 > seen_correlation


def volume_spacing(volume):
    return float(np.linalg.norm(volume.index_to_patient[:3, 0]))


def test_points_come_back_to_where_they_were(pressed):
    scene, _, sweep = pressed
    rest = build_rest_placement(scene, sweep, ImagePart())
    mesh = rest.solver.model.mesh
    nodes = rest.solver.deform(rest.poses[3]).nodes
    inner = np.flatnonzero(np.linalg.norm(mesh.nodes - [0, 0, 0.025], axis=1) < 0.02)
    assert np.linalg.norm(nodes[inner] - mesh.nodes[inner], axis=1).max() > 5e-4
    np.testing.assert_allclose(rest(3, nodes[inner]), mesh.nodes[inner], atol=1e-9)
    assert np.isnan(rest(3, np.array([[0.0, 0.0, -0.05]]))).all()


def test_the_probe_is_where_its_image_begins(pressed):
    _, _, sweep = pressed
    pose = find_probe_pose(sweep.image_to_reference[4], ImagePart(), sweep.columns)
    np.testing.assert_allclose(pose.position, [0.0, ACROSS[4], PRESS], atol=1e-9)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-9)


def test_a_scene_without_tissue_is_refused(pressed):
    scene, _, sweep = pressed
    with pytest.raises(SceneError, match="tissue"):
        build_rest_placement(dataclasses.replace(scene, tissue=None), sweep, ImagePart())


@pytest.mark.slow
def test_the_command_places_images_at_rest(pressed, small_scene, tmp_path, capsys):
    scene, _, sweep = pressed
    out = tmp_path / "rest.nrrd"
    words = ["reconstruct", str(sweep.path), "--out", str(out), "--spacing", "1 mm"]
    assert main([*words, "--undo-pressure", str(small_scene)]) == 0
    assert "from 25 frames" in capsys.readouterr().out
    how = Compounding(spacing=1e-3)
    rest = build_rest_placement(scene, sweep, ImagePart())
    made = reconstruct(plan_insertion(sweep, how, rest=rest))
    np.testing.assert_array_equal(read_volume(out).intensities, made.volume.intensities)
    assert made.volume.shape[2] > 40  # the probe's depth of 40 mm, and what it had pressed down
    words[words.index(str(out))] = str(tmp_path / "rest")
    assert main([*words, "--undo-pressure", str(small_scene)]) == 0
    start = read_case(tmp_path / "rest").settings.start
    assert 0.0 <= start.position[2] < 2e-3 < PRESS  # two voxels, not where it had pressed
    np.testing.assert_allclose(start.pose.rotation, np.eye(3), atol=1e-6)


PROBE = {"aperture": "40 mm", "depth": "40 mm", "image": [200, 200]}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "press.mcap"
    write_path(file, make_press_and_slide(rate=6.0), sidecar=False)
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


def placed(folder, path, volume, position, **more):
    """A scene with the volume at a position, the path, and that volume as the scene places it."""
    scene = scene_at(folder, position, **more)
    matrix = scene.volume.pose.pose.matrix @ volume.index_to_patient
    return scene, path, Volume(volume.intensities, matrix)


@pytest.mark.parametrize(("shift", "part"), [(0.0, 1.0), (20e-3, 0.5), (-30e-3, 0.25)])
def test_the_part_inside_is_that_of_the_rectangle(shift, part):
    probe = LinearProbe(aperture=0.04, depth=0.04, columns=400, rows=400)
    grid = np.diag([1e3, 1e3, 1e3, 1.0])
    grid[:3, 3] = [19.5, 20, -0.5]  # x from -20 to 20 mm, z from 0 to 40 mm
    (found,) = compute_part_inside(probe, [Pose([shift, 0, 0])], grid, (40, 40, 40))
    assert found == pytest.approx(part, abs=0.04)


def test_the_corners_that_no_beam_reaches_do_not_count():
    probe = ConvexProbe(
        radius=0.05, opening_angle=np.pi / 3, depth=0.1, columns=300, rows=300, lines=64
    )
    grid = np.diag([1e3, 1e3, 1e3, 1.0])
    grid[:3, 3] = [-30.5, 10, 100]  # all that is beyond x = 30 mm
    (found,) = compute_part_inside(probe, [Pose()], grid, (500, 50, 500))
    angle, radius = np.meshgrid(
        np.linspace(-1, 1, 801) * np.pi / 6, np.linspace(0.05, 0.15, 801), indexing="ij"
    )
    part = (radius * (radius * np.sin(angle) > 0.03)).sum() / radius.sum()
    assert found == pytest.approx(part, abs=0.02)


@pytest.mark.parametrize(
    ("position", "more"),
    [
        ((0, 0, 0), {}),
        ((0, 0, 0.03), {}),  # a twentieth of the deepest image
        # The probe's own poses are not registered again.
        ((0, 0, 0), {"tracker": {"frame": "ndi", "registration": {"position": [0.3, 0, 0]}}}),
    ],
)
def test_a_scene_whose_images_meet_the_volume_is_taken(tmp_path, path, volume, position, more):
    check_path_in_volume(*placed(tmp_path, path, volume, position, **more))


@pytest.mark.parametrize(
    ("position", "more", "fact"),
    [
        ((0.2, 0, 0), {}, "seen in no image"),
        ((0, 0, 0.04), {}, "seen in no image"),  # 52 mm deep at most, and scanned from 60 mm on
        ((0, 0, 0), {"tracker": {"registration": {"position": [0.3, 0, 0]}}}, "seen in no image"),
    ],
)
def test_a_volume_beside_the_path_is_refused(tmp_path, path, volume, position, more, fact):
    with pytest.raises(SceneError, match=rf"body\.nrrd.*{fact}"):
        check_path_in_volume(*placed(tmp_path, path, volume, position, **more))


@pytest.mark.parametrize("command", ["run", "render"])
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
    assert "press.mcap" in said.err
    assert "Traceback" not in said.err
    assert not list((tmp_path / "out").glob("*")) if (tmp_path / "out").exists() else True
