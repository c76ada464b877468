"""A vessel's area is compared with that of the same plane at rest."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from us_sim.geometry.pose import Pose
from us_sim.run.session_summary import Session
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

MM = 1e-3
BLOCK = box_mesh(
    uniform_planes(-0.03, 0.03, 7), uniform_planes(-0.02, 0.02, 5), uniform_planes(0.0, 0.06, 7)
)
PROBE = LinearProbe(aperture=0.05, depth=0.05, columns=100, rows=100)


def cone():
    """A vessel along y that gets wider, 30 mm below the skin: 2 mm at y = -20 mm, 10 at 20."""
    x, y, z = np.meshgrid(*(np.arange(n) for n in (61, 41, 61)), indexing="ij")
    inside = np.hypot(x - 30, z - 30) <= 2 + 8 * y / 40
    to_patient = np.diag([MM, MM, MM, 1.0])
    to_patient[:3, 3] = [-0.03, -0.02, 0.0]
    labels = inside.astype(np.uint8)
    return Volume(np.ones_like(labels), to_patient, labels, {0: "tissue", 1: "vein"})


def measured(monkeypatch, poses, nodes):
    """The areas of a session in which the tissue was at ``nodes``, one array a pose."""
    stamps = range(len(poses))
    times = {"/ultrasound/image": pd.DataFrame({"stamp": stamps})}
    session = Session(
        SimpleNamespace(),
        dict(zip(stamps, poses, strict=True)),
        dict(zip(stamps, nodes, strict=True)),
        BLOCK.nodes,
        BLOCK.tetrahedra,
        times,
        {},
    )
    scanner = BMode(cone(), PROBE)
    scanner.attach_mesh(BLOCK.nodes, BLOCK.tetrahedra)
    monkeypatch.setattr(Session, "find_vessels", lambda *_: ({"vein": (1,)}, scanner))
    return session.measure_lumens(None, 100).collect_comparable_sections()


def test_sliding_along_a_cone_without_pressing_it_changes_nothing(monkeypatch):
    poses = [Pose([0.0, y, 0.004]) for y in np.linspace(-0.015, 0.015, 7)]
    areas = measured(monkeypatch, poses, [BLOCK.nodes] * 7)
    assert areas["vein"].area[-1] > 4 * areas["vein"].area[0]
    cut = np.isfinite(areas["vein"].fraction)
    assert cut.sum() >= 5
    np.testing.assert_allclose(areas["vein"].fraction[cut], 1.0, atol=0.06)


def test_tissue_pressed_to_half_its_height_halves_the_area_wherever_it_is_cut(monkeypatch):
    poses = [Pose([0.0, y, 0.0]) for y in (0.0, 0.006, 0.012)]
    half = BLOCK.nodes * [1.0, 1.0, 0.5]
    areas = measured(monkeypatch, [Pose([0, 0, 0]), *poses], [BLOCK.nodes, half, half, half])
    np.testing.assert_allclose(areas["vein"].fraction, [1.0, 0.5, 0.5, 0.5], atol=0.03)
    assert areas["vein"].fraction[2] == pytest.approx(0.5, abs=0.03)


def test_a_plane_that_hardly_cuts_the_vessel_is_compared_with_nothing(monkeypatch):
    poses = [Pose([0.0, 0.015, 0.0]), Pose([0.0, -0.0199, 0.0]), Pose([0.05, 0.0, 0.0])]
    areas = measured(monkeypatch, poses, [BLOCK.nodes] * 3)
    assert areas["vein"].fraction[0] == 1.0
    assert np.isnan(areas["vein"].fraction[1:]).all()


def test_a_vessel_that_no_image_cuts_is_not_told(monkeypatch):
    assert not measured(monkeypatch, [Pose([0.05, 0.0, 0.0])] * 2, [BLOCK.nodes] * 2)


def test_a_vessel_that_the_image_cuts_or_that_left_it_is_not_taken_for_a_closed_one(monkeypatch):
    aside = [0.0, 0.0, 0.008, 0.016, 0.024, 0.024]  # m, by which the vessel is pushed away
    nodes = [np.add(BLOCK.nodes, [x, 0.0, 0.0]) for x in aside]
    nodes[1] = BLOCK.nodes * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.03]  # closed where it is
    poses = [Pose([-0.005, 0.01, 0.0])] * len(nodes)
    areas = measured(monkeypatch, poses, nodes)
    fraction = areas["vein"].fraction
    np.testing.assert_allclose(fraction[[0, 2]], 1.0, atol=0.03)
    assert fraction[1] < 0.1
    assert np.isnan(fraction[3:]).all()
