"""Displacement and strain against closed forms, VTK's derivatives, and laws; the colour bar."""

import math

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
from us_sim.slicing.strain import AxialStrain, compute_displacement
from us_sim.slicing.strain_estimate import warm_up
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.volume import Volume

VOLUME = Volume(np.full((8, 8, 8), 99, np.uint8), np.diag([0.01, 0.01, 0.01, 1.0]))
PROBES = (
    LinearProbe(aperture=0.04, depth=0.04, columns=40, rows=30),
    ConvexProbe(radius=0.03, opening_angle=1.0, depth=0.04, columns=40, rows=30),
    SectorProbe(aperture=0.01, opening_angle=1.4, depth=0.04, columns=40, rows=30),
)
ANGLES = st.floats(-0.4, 0.4)
GRADIENTS = st.lists(st.floats(-0.15, 0.15), min_size=9, max_size=9)
ALL_PROBES = pytest.mark.parametrize("probe", PROBES, ids=lambda p: type(p).__name__)


def block(count=5):
    planes = np.linspace(-0.04, 0.04, count)
    return box_mesh(planes, planes, np.linspace(-0.01, 0.07, count))


MESH = block()


def framed(probe, pose, nodes, mesh=MESH):
    scanner = BMode(VOLUME, probe)
    scanner.attach_mesh(mesh.nodes, mesh.tetrahedra)
    return scanner.make_frame(pose, nodes)


def turned(turn):
    return Pose([1e-3, -2e-3, 3e-3], [*np.array(turn) / 2, 1.0])


def beams_of(frame):
    """(rows, columns, 3) unit directions in ``patient``, from the geometry of each kind."""
    probe, pixels = (
        frame.probe,
        frame.pose.inverse().transform_points(frame.plane.compute_pixel_positions()),
    )
    x, z = pixels[..., 0], pixels[..., 2]
    if isinstance(probe, LinearProbe):
        local = np.stack([0 * x, 0 * x, 0 * x + 1], axis=-1)
    else:
        below = z + probe.radius  # of the arc's centre, or of the apex
        local = np.stack([x, 0 * x, below], axis=-1) / np.hypot(x, below)[..., None]
    return local @ frame.pose.rotation.T


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(PROBES), st.tuples(ANGLES, ANGLES, ANGLES), GRADIENTS)
def test_a_homogeneous_deformation_strains_every_beam_as_its_gradient_does(probe, turn, gradient):
    stretch = np.eye(3) + np.array(gradient).reshape(3, 3)
    frame = framed(probe, turned(turn), MESH.nodes @ stretch.T)
    found = AxialStrain.from_frame(frame).compute_strain(frame)
    assert found.dtype == np.float32
    # A unit line along the beam now was |F⁻¹ d| long.
    expected = 1.0 / np.linalg.norm(beams_of(frame) @ np.linalg.inv(stretch).T, axis=-1) - 1.0
    there = np.isfinite(found)
    assert there.mean() > 0.3
    np.testing.assert_allclose(found[there], expected[there], atol=2e-6)
    np.testing.assert_array_equal(~there, np.isnan(compute_displacement(frame)[..., 0]))


@ALL_PROBES
def test_strain_since_another_state_is_that_of_what_happened_since(probe):
    rng = np.random.default_rng(4)
    before = MESH.nodes @ (np.eye(3) + rng.uniform(-0.1, 0.1, (3, 3))).T
    since = np.eye(3) + rng.uniform(-0.05, 0.05, (3, 3))
    frame = framed(probe, turned([0.2, -0.1, 0.1]), before @ since.T)
    strain = AxialStrain.from_frame(frame)
    found = strain.compute_strain(frame, before)
    expected = 1.0 / np.linalg.norm(beams_of(frame) @ np.linalg.inv(since).T, axis=-1) - 1.0
    there = np.isfinite(found)
    np.testing.assert_allclose(found[there], expected[there], atol=2e-6)
    np.testing.assert_allclose(strain.compute_strain(frame, frame.nodes)[there], 0.0, atol=1e-6)
    assert np.abs(strain.compute_strain(frame)[there] - found[there]).max() > 0.01


def test_the_uniaxial_press_of_a_block_is_the_textbooks():
    """Between frictionless plates: λ along z, λ^-ν across for small strains."""
    squeezed = MESH.nodes * [1.02, 1.02, 0.95]
    frame = framed(PROBES[0], Pose(), squeezed)
    found = AxialStrain.from_frame(frame).compute_strain(frame)
    np.testing.assert_allclose(found[np.isfinite(found)], -0.05, atol=1e-6)


def bent(points):
    """A smooth displacement, and its engineering strain along z now, at (P, 3) of rest."""
    x, y, z = points.T
    u = 0.02 * np.sin(40 * z) / 40
    return points + np.stack([0 * x, 0 * y, u + 0.1 * x * z], axis=1)


def test_the_error_of_a_smooth_strain_falls_with_the_square_of_the_meshs_width():
    errors = []
    for count in (9, 17, 33):
        mesh = block(count)
        frame = framed(PROBES[0], Pose(), bent(mesh.nodes), mesh)
        found = AxialStrain.from_frame(frame).compute_strain(frame)[3:-3, 3:-3].astype(float)
        now = frame.plane.compute_pixel_positions()[3:-3, 3:-3].reshape(-1, 3)
        rest = now.copy()
        for _ in range(60):  # X = x - u(X)
            rest += now - bent(rest)
        x, _, z = rest.T
        # c = F⁻ᵀF⁻¹ with F = 1 but for its last row, (0.1 z, 0, 1 + u' + 0.1 x): F⁻¹ e_z.
        expected = (1.0 + 0.02 * np.cos(40 * z) + 0.1 * x) - 1.0
        errors.append(np.sqrt(np.mean((found.ravel() - expected) ** 2)))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.6).all(), (errors, orders)
    assert errors[-1] < 2e-4


@pytest.mark.slow
@ALL_PROBES
def test_it_is_the_mean_of_what_vtk_says_of_the_tetrahedra(probe):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy

    rng = np.random.default_rng(11)
    mesh = block(6)
    nodes = mesh.nodes + rng.uniform(-1.5e-3, 1.5e-3, mesh.nodes.shape)
    frame = framed(probe, turned([0.1, 0.2, -0.3]), nodes, mesh)

    def grid(points):
        made = vtk.vtkUnstructuredGrid()
        places = vtk.vtkPoints()
        places.SetData(numpy_to_vtk(points, deep=True))
        made.SetPoints(places)
        array = vtk.vtkCellArray()
        corners = mesh.tetrahedra.astype(np.int64).ravel()
        array.SetData(4, numpy_to_vtkIdTypeArray(corners, deep=True))
        made.SetCells(vtk.VTK_TETRA, array)
        return made

    deformed = grid(nodes)
    rest = numpy_to_vtk(mesh.nodes, deep=True)
    rest.SetName("rest")
    deformed.GetPointData().AddArray(rest)
    derive = vtk.vtkCellDerivatives()
    derive.SetInputData(deformed)
    deformed.GetPointData().SetActiveVectors("rest")
    derive.SetTensorModeToComputeGradient()
    derive.Update()
    inverse = vtk_to_numpy(derive.GetOutput().GetCellData().GetTensors()).reshape(-1, 3, 3)
    if not np.allclose(
        inverse[0] @ (nodes[mesh.tetrahedra[0, 1]] - nodes[mesh.tetrahedra[0, 0]]),
        mesh.nodes[mesh.tetrahedra[0, 1]] - mesh.nodes[mesh.tetrahedra[0, 0]],
    ):
        inverse = inverse.transpose(0, 2, 1)  # of its versions some have rows for columns
    tensor = np.einsum("eki,ekj->eij", inverse, inverse)
    corners = nodes[mesh.tetrahedra]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    total, weight = np.zeros((len(nodes), 3, 3)), np.zeros(len(nodes))
    for k in range(4):
        np.add.at(total, mesh.tetrahedra[:, k], volume[:, None, None] * tensor)
        np.add.at(weight, mesh.tetrahedra[:, k], volume)
    mean = numpy_to_vtk((total / weight[:, None, None]).reshape(-1, 9), deep=True)
    mean.SetName("c")
    deformed.GetPointData().AddArray(mean)
    pixels = frame.plane.compute_pixel_positions().reshape(-1, 3)
    places, cloud = vtk.vtkPoints(), vtk.vtkPolyData()
    places.SetData(numpy_to_vtk(pixels, deep=True))
    cloud.SetPoints(places)
    probing = vtk.vtkProbeFilter()
    probing.SetInputData(cloud)
    probing.SetSourceData(deformed)
    probing.Update()
    c = vtk_to_numpy(probing.GetOutput().GetPointData().GetArray("c")).reshape(-1, 3, 3)
    found = AxialStrain.from_frame(frame).compute_strain(frame).ravel()
    there = np.isfinite(found) & (np.trace(c, axis1=1, axis2=2) > 0)
    assert there.sum() > 400
    d = beams_of(frame).reshape(-1, 3)
    length = np.einsum("pi,pij,pj->p", d, c, d)[there]
    error = np.abs(found[there] - (1 / np.sqrt(length) - 1))
    assert np.percentile(error, 98) < 2e-6
    assert error.max() < 1e-3  # VTK takes a neighbour within its tolerance
    assert np.abs(found[there]).max() > 0.05


def test_tetrahedra_that_are_inside_out_do_not_count():
    mesh = block(9)
    nodes = mesh.nodes * [1, 1, 0.9]
    nodes[np.argmin(np.linalg.norm(mesh.nodes - [0, 0, 0.03], axis=1))] += [0, 0, 0.03]
    frame = framed(PROBES[0], Pose(), nodes, mesh)
    found = AxialStrain.from_frame(frame).compute_strain(frame)
    assert frame.slicer.skipped > 0
    there = found[np.isfinite(found)]
    assert there.size
    assert (there > -1.0).all()
    assert abs(np.median(there) + 0.1) < 0.02


@ALL_PROBES
def test_directions_of_pixels_are_those_of_the_beams_through_them(probe):
    directions = probe.pixel_directions
    frame = framed(probe, Pose(), MESH.nodes)
    expected = beams_of(frame)[..., [0, 2]]
    reached = ~np.isnan(directions[0])
    np.testing.assert_array_equal(reached, frame.plane.make_shown_mask())
    found = np.moveaxis(directions, 0, -1)
    np.testing.assert_allclose(found[reached], expected[reached], atol=1e-5)
    assert math.isclose(np.hypot(*directions)[reached].min(), 1.0, abs_tol=1e-5)


def test_what_has_no_strain_is_said():
    frame = framed(PROBES[0], Pose(), None)
    with pytest.raises(MeshError, match="no tissue"):
        AxialStrain.from_frame(frame)
    frame = framed(PROBES[0], Pose(), MESH.nodes)
    with pytest.raises(MeshError, match=r"125 nodes.*\(7, 3\)"):
        AxialStrain.from_frame(frame).compute_strain(frame, MESH.nodes[:7])
    other = AxialStrain(block(6).nodes, block(6).tetrahedra)
    with pytest.raises(MeshError, match=r"216 nodes.*\(125, 3\)"):
        other.compute_strain(frame)
    warm_up()


PLANES = np.linspace(-0.03, 0.03, 5)
MOVED_MESH = box_mesh(PLANES, PLANES, np.linspace(0.0, 0.05, 5))
MOVED_PROBES = (
    LinearProbe(aperture=0.05, depth=0.06, columns=30, rows=25),
    ConvexProbe(radius=0.03, opening_angle=1.0, depth=0.05, columns=30, rows=25),
    SectorProbe(aperture=0.01, opening_angle=1.5, depth=0.05, columns=30, rows=25),
)
MOVED_ANGLES = st.floats(-0.6, 0.6)


def scanner(probe):
    made = BMode(VOLUME, probe)
    made.attach_mesh(MOVED_MESH.nodes, MOVED_MESH.tetrahedra)
    return made


@settings(max_examples=20, deadline=None)
@given(
    st.sampled_from(MOVED_PROBES),
    st.tuples(MOVED_ANGLES, MOVED_ANGLES, MOVED_ANGLES),
    st.lists(st.floats(-0.2, 0.2), min_size=9, max_size=9),
)
def test_it_is_that_of_the_deformation_in_the_axes_of_the_probe(probe, turn, gradient):
    pose = Pose([0.003, -0.002, 0.004], [*np.array(turn) / 2, 1.0])
    stretch = np.eye(3) + np.array(gradient).reshape(3, 3)
    nodes = MOVED_MESH.nodes @ stretch.T + [1e-3, 2e-3, -1e-3]
    frame = scanner(probe).make_frame(pose, nodes)
    found = compute_displacement(frame)
    assert found.shape == (25, 30, 2)
    assert found.dtype == np.float32
    now = frame.plane.compute_pixel_positions()
    rest = (now - [1e-3, 2e-3, -1e-3]) @ np.linalg.inv(stretch).T
    expected = ((now - rest) @ pose.rotation)[..., [0, 2]]
    inside = ((rest > MOVED_MESH.nodes.min(axis=0)) & (rest < MOVED_MESH.nodes.max(axis=0))).all(
        axis=-1
    )
    inside &= frame.plane.make_shown_mask()
    assert inside.mean() > 0.1
    np.testing.assert_allclose(found[inside], expected[inside], atol=1e-8)
    edge = (
        (rest > MOVED_MESH.nodes.min(axis=0) - 1e-9) & (rest < MOVED_MESH.nodes.max(axis=0) + 1e-9)
    ).all(-1)
    assert np.isnan(found[~edge | ~frame.plane.make_shown_mask()]).all()


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("tangled", "squashed")])
def test_it_is_where_the_method_that_tries_every_tetrahedron_says(kind):
    for seed in range(4):
        rest, tetrahedra, nodes, plane, volume = random_case(kind, seed)
        slicer, oracle = (
            create_slicer(method, volume, rest, tetrahedra)
            for method in ("scan_conversion", "per_pixel")
        )
        frame = Frame(Pose(), nodes, MOVED_PROBES[0], volume, slicer)
        frame.plane = plane
        found = compute_displacement(frame)
        expected = plane.compute_pixel_positions() - oracle.compute_rest_coordinates(nodes, plane)
        expected[oracle.locate_pixels(nodes, plane).elements < 0] = np.nan
        outside = np.isnan(found[..., 0])
        np.testing.assert_allclose(found[~outside], expected[~outside][:, [0, 2]], atol=1e-7)
        rigid = np.isnan(expected[..., 0]) | (np.abs(expected) < 1e-12).all(axis=-1)
        assert rigid[outside].all()
