"""A mesh that follows a ball in a box: its volumes, its interface, and how it gives way."""

import contextlib
import subprocess

import numpy as np
import pytest

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.scene import building
from us_sim.scene.conforming_tissue import conforming_tissue
from us_sim.scene.reading import parse_scene
from us_sim.tissue.mesh.tetrahedral_mesh import MeshSettings
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear
from us_sim.volume.volume import Volume

RADIUS, DEPTH = 8e-3, 20e-3
LOWER, UPPER = np.array([-0.025, -0.025, 0.0]), np.array([0.025, 0.025, 0.045])


@pytest.fixture(scope="module")
def volume():
    grid = np.diag([0.5e-3, 0.5e-3, 0.5e-3, 1.0])
    grid[:3, 3] = LOWER - 0.003
    points = np.moveaxis(np.indices((112, 112, 102)), 0, -1) * 0.5e-3 + grid[:3, 3]
    labels = (np.linalg.norm(points - [0.0, 0.0, DEPTH], axis=-1) < RADIUS).astype(np.uint8)
    return Volume(np.zeros_like(labels), grid, labels, {0: "tissue", 1: "cyst"})


def scene(nodes, kind):
    probe = {"aperture": "20 mm", "depth": "40 mm", "image": [64, 64]}
    probe["collider"] = dict.fromkeys(("length", "width", "height"), "34 mm")
    probe["collider"] |= {"shape": "rounded_box", "rounding": "4 mm"}
    mesh = {"lower": LOWER.tolist(), "upper": UPPER.tolist(), "nodes": nodes, "kind": kind}
    stiff = {"young_modulus": "60 kPa", "poisson_ratio": 0.45, "density": 1000}
    return parse_scene(
        {
            "name": "ball",
            "volume": {"phantom": "upper_arm"},
            "probe": probe,
            "structures": ["cyst"],
            "tissue": {
                "solver": "fem_nonlinear",
                "mesh": mesh,
                "fixed": ["bottom"],
                "materials": {"tissue": {**stiff, "young_modulus": "10 kPa"}, "cyst": stiff},
            },
        }
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the mesher is called."""
    return tmp_path_factory.mktemp("called_here")


@pytest.fixture(scope="module")
def conforming(volume, folder):
    with contextlib.chdir(folder):
        return conforming_tissue(scene(1000, "conforming"), volume)


@pytest.mark.usefixtures("conforming")
def test_it_leaves_no_files_where_it_is_called(folder):
    assert not list(folder.iterdir())


def test_it_fills_the_box_and_the_ball_within_two_percent(conforming):
    mesh, fractions = conforming
    assert 300 < len(mesh.nodes) <= 1000
    assert mesh.volumes.min() > 0.0
    np.testing.assert_array_equal(mesh.nodes.min(axis=0), LOWER)
    np.testing.assert_array_equal(mesh.nodes.max(axis=0), UPPER)
    assert mesh.volumes.sum() == pytest.approx(np.prod(UPPER - LOWER), rel=1e-6)
    ball = 4 / 3 * np.pi * RADIUS**3
    assert set(np.unique(fractions.of(1))) == {0.0, 1.0}
    assert fractions.of(1) @ mesh.volumes == pytest.approx(ball, rel=0.02)


def test_its_interface_is_on_the_ball(conforming):
    mesh, fractions = conforming
    inside = np.zeros(len(mesh.nodes), dtype=bool)
    inside[mesh.tetrahedra[fractions.of(1) == 1.0]] = True
    outside = np.zeros(len(mesh.nodes), dtype=bool)
    outside[mesh.tetrahedra[fractions.of(1) == 0.0]] = True
    radius = np.linalg.norm(mesh.nodes[inside & outside] - [0.0, 0.0, DEPTH], axis=1)
    assert len(radius) > 30
    assert np.abs(radius - RADIUS).max() < 0.6e-3


def test_it_gives_way_as_a_grid_does(conforming, volume, monkeypatch):
    moved = []
    for kind, nodes in (("conforming", 1000), ("grid", 1000)):
        if kind == "conforming":
            monkeypatch.setattr(
                "us_sim.scene.conforming_tissue.conforming_tissue", lambda *_: conforming
            )
        given = scene(nodes, kind)
        model = building.tissue_model_of(given, volume)
        solver = FemNonlinear(model)
        for depth in np.linspace(0.0, 6e-3, 7):
            deformation = solver.deform(Pose(position=[0.0, 0.0, depth]))
        corners = model.mesh.tetrahedra
        ball = model.materials.young_modulus > 55e3
        shift = (deformation.nodes - model.mesh.nodes)[corners].mean(axis=1)
        weight = model.mesh.volumes * ball
        moved.append(weight @ shift[:, 2] / weight.sum())
    assert moved[1] > 1e-3
    assert moved[0] == pytest.approx(moved[1], rel=0.1)


def test_what_the_mesher_cannot_do_is_said_in_a_sentence(volume, monkeypatch):
    def slow(command, **_):
        raise subprocess.TimeoutExpired(command, 1.0)

    given = scene(1000, "conforming")
    monkeypatch.setattr("us_sim.tissue.mesh.conforming.subprocess.run", slow)
    with pytest.raises(MeshError, match=r"fTetWild made no mesh .*kind: grid"):
        conforming_tissue(given, volume)
    crashed = subprocess.CompletedProcess([], -11, b"", b"")
    monkeypatch.setattr("us_sim.tissue.mesh.conforming.subprocess.run", lambda *_, **__: crashed)
    with pytest.raises(MeshError, match="status -11"):
        conforming_tissue(given, volume)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MeshError, match=r"us_sim\[conforming\]"):
        conforming_tissue(given, volume)


def test_a_conforming_mesh_needs_one_number_of_nodes():
    with pytest.raises(MeshError, match="one number"):
        MeshSettings(lower=(0, 0, 0), upper=(1, 1, 1), kind="conforming")
