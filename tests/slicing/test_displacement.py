"""The displacement of each pixel's tissue against what the mesh was given."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slicing_cases import KINDS, random_case

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.slicing.strain import displacement
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.volume import Volume

PLANES = np.linspace(-0.03, 0.03, 5)
MESH = box_mesh(PLANES, PLANES, np.linspace(0.0, 0.05, 5))
VOLUME = Volume(np.full((8, 8, 8), 99, np.uint8), np.diag([0.01, 0.01, 0.01, 1.0]))
PROBES = (
    LinearProbe(aperture=0.05, depth=0.06, columns=30, rows=25),
    ConvexProbe(radius=0.03, opening_angle=1.0, depth=0.05, columns=30, rows=25),
    SectorProbe(aperture=0.01, opening_angle=1.5, depth=0.05, columns=30, rows=25),
)
ANGLES = st.floats(-0.6, 0.6)


def scanner(probe):
    made = BMode(VOLUME, probe)
    made.carry(MESH.nodes, MESH.tetrahedra)
    return made


@settings(max_examples=20, deadline=None)
@given(
    st.sampled_from(PROBES),
    st.tuples(ANGLES, ANGLES, ANGLES),
    st.lists(st.floats(-0.2, 0.2), min_size=9, max_size=9),
)
def test_it_is_that_of_the_deformation_in_the_axes_of_the_probe(probe, turn, gradient):
    pose = Pose([0.003, -0.002, 0.004], [*np.array(turn) / 2, 1.0])
    stretch = np.eye(3) + np.array(gradient).reshape(3, 3)
    nodes = MESH.nodes @ stretch.T + [1e-3, 2e-3, -1e-3]
    frame = scanner(probe).frame(pose, nodes)
    found = displacement(frame)
    assert found.shape == (25, 30, 2)
    assert found.dtype == np.float32
    now = frame.plane.pixels()
    rest = (now - [1e-3, 2e-3, -1e-3]) @ np.linalg.inv(stretch).T
    expected = ((now - rest) @ pose.rotation)[..., [0, 2]]
    inside = ((rest > MESH.nodes.min(axis=0)) & (rest < MESH.nodes.max(axis=0))).all(axis=-1)
    inside &= frame.plane.is_shown()
    assert inside.mean() > 0.1
    np.testing.assert_allclose(found[inside], expected[inside], atol=1e-8)
    edge = ((rest > MESH.nodes.min(axis=0) - 1e-9) & (rest < MESH.nodes.max(axis=0) + 1e-9)).all(-1)
    assert np.isnan(found[~edge | ~frame.plane.is_shown()]).all()


def test_the_probes_own_motion_is_no_part_of_it():
    pressed = MESH.nodes * [1, 1, 0.9] + [0, 0, 0.005]
    for z in (0.0, 0.005, 0.01):
        found = displacement(scanner(PROBES[0]).frame(Pose([0, 0, z]), pressed))
        depths = z + 0.06 * (np.arange(25) + 0.5) / 25
        inside = (depths > 0.0051) & (depths < 0.0499)
        expected = 0.05 / 9 - depths / 9  # of what lay at (z - 5 mm) / 0.9
        np.testing.assert_allclose(found[inside, 15, 1], expected[inside], atol=1e-8)
        np.testing.assert_allclose(found[inside, 15, 0], 0.0, atol=1e-8)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("tangled", "squashed")])
def test_it_is_where_the_method_that_tries_every_tetrahedron_says(kind):
    for seed in range(4):
        rest, tetrahedra, nodes, plane, volume = random_case(kind, seed)
        slicer, oracle = (
            create_slicer(method, volume, rest, tetrahedra)
            for method in ("scan_conversion", "per_pixel")
        )
        frame = Frame(Pose(), nodes, PROBES[0], volume, slicer)
        frame.plane = plane
        found = displacement(frame)
        expected = plane.pixels() - oracle.rest_coordinates(nodes, plane)
        expected[oracle.locate(nodes, plane).elements < 0] = np.nan
        outside = np.isnan(found[..., 0])
        np.testing.assert_allclose(found[~outside], expected[~outside][:, [0, 2]], atol=1e-7)
        rigid = np.isnan(expected[..., 0]) | (np.abs(expected) < 1e-12).all(axis=-1)
        assert rigid[outside].all()


def test_without_tissue_there_is_none():
    with pytest.raises(MeshError, match="no tissue carries the volume"):
        displacement(scanner(PROBES[0]).frame(Pose()))
