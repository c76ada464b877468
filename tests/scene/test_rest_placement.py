"""A pressed sweep, reconstructed as it was seen and as it lies at rest."""

import dataclasses

import numpy as np
import pytest
from sweep_file import write_sweep

from us_sim.command.main import main
from us_sim.errors import SceneError
from us_sim.geometry.pose import Pose
from us_sim.scene.building import probe_of, tissue_model_of, volume_of
from us_sim.scene.placement import probe_pose, rest_placement
from us_sim.scene.reading import load_scene
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.tissue.solvers.solver import create_solver
from us_sim.volume.files.readers import read_volume
from us_sim.volume.reconstruction.reconstruction import plan, reconstruct
from us_sim.volume.reconstruction.settings import Compounding, ImagePart
from us_sim.volume.sequences.sweep import read_sweep

PRESS = 0.006  # m
ACROSS = np.linspace(-0.012, 0.012, 25)  # m, of the probe along its elevation


@pytest.fixture(scope="module")
def pressed(small_scene, tmp_path_factory):
    """The scene, its volume, and a sweep of images that the pressing probe sees."""
    scene = load_scene(small_scene)
    volume, probe = volume_of(scene), probe_of(scene)
    model = tissue_model_of(scene, volume)
    solver = create_solver("fem", model)
    mesh = model.mesh
    slicer = create_slicer("scan_conversion", volume, mesh.nodes, mesh.tetrahedra)
    images, matrices = [], []
    for y in ACROSS:
        pose = Pose([0.0, float(y), PRESS])
        images.append(slicer.image(solver.deform(pose).nodes, probe.plane(pose)))
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
    how = Compounding(spacing=volume_spacing(volume), method="linear")
    as_seen = reconstruct(plan(sweep, how))
    rest = rest_placement(scene, sweep, ImagePart())
    at_rest = reconstruct(plan(sweep, how, rest=rest))
    seen, seen_correlation = difference(as_seen, volume)
    undone, undone_correlation = difference(at_rest, volume)
    # Measured: 26.1 and 18.7 grey levels, correlations of 0.29 and 0.76, most of it of speckle.
    assert undone < 0.75 * seen
    assert undone_correlation > 0.7 > 0.4 > seen_correlation


def volume_spacing(volume):
    return float(np.linalg.norm(volume.index_to_patient[:3, 0]))


def test_points_come_back_to_where_they_were(pressed):
    scene, _, sweep = pressed
    rest = rest_placement(scene, sweep, ImagePart())
    mesh = rest.solver.model.mesh
    nodes = rest.solver.deform(rest.poses[3]).nodes
    inner = np.flatnonzero(np.linalg.norm(mesh.nodes - [0, 0, 0.025], axis=1) < 0.02)
    assert np.linalg.norm(nodes[inner] - mesh.nodes[inner], axis=1).max() > 5e-4
    np.testing.assert_allclose(rest(3, nodes[inner]), mesh.nodes[inner], atol=1e-9)
    assert np.isnan(rest(3, np.array([[0.0, 0.0, -0.05]]))).all()


def test_the_probe_is_where_its_image_begins(pressed):
    _, _, sweep = pressed
    pose = probe_pose(sweep.image_to_reference[4], ImagePart(), sweep.columns)
    np.testing.assert_allclose(pose.position, [0.0, ACROSS[4], PRESS], atol=1e-9)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-9)


def test_a_scene_without_tissue_is_refused(pressed):
    scene, _, sweep = pressed
    with pytest.raises(SceneError, match="has no tissue"):
        rest_placement(dataclasses.replace(scene, tissue=None), sweep, ImagePart())


def test_the_command_places_images_at_rest(pressed, small_scene, tmp_path, capsys):
    scene, _, sweep = pressed
    out = tmp_path / "rest.nrrd"
    words = ["reconstruct", str(sweep.path), "--out", str(out), "--spacing", "1 mm"]
    assert main([*words, "--undo-pressure", str(small_scene)]) == 0
    assert "from 25 frames" in capsys.readouterr().out
    how = Compounding(spacing=1e-3)
    rest = rest_placement(scene, sweep, ImagePart())
    made = reconstruct(plan(sweep, how, rest=rest))
    np.testing.assert_array_equal(read_volume(out).intensities, made.volume.intensities)
    assert made.volume.shape[2] > 40  # the probe's depth of 40 mm, and what it had pressed down
