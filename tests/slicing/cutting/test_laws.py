"""Laws of every slicing method, and numbers known beforehand."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.ndimage import map_coordinates
from slicing_cases import (
    HIGH,
    KINDS,
    LOW,
    SIZE,
    around_the_box,
    box,
    every_method,
    noise_volume,
    random_case,
)

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.resampling import sample_labels, sample_plane
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.cutting.span_sampling import SLACK
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.volume import Volume


def random_affine(rng):
    """A matrix that turns, shears and stretches, without mirroring, and a shift."""
    turn = Pose(np.zeros(3), [*rng.normal(scale=0.2, size=3), 1.0]).rotation
    return turn @ (np.diag(rng.uniform(0.6, 1.5, 3)) + rng.uniform(-0.2, 0.2, (3, 3))), rng.normal(
        scale=2e-3, size=3
    )


def random_plane(rng, columns=72, rows=56, width=0.07):
    pose = Pose(rng.normal([0.0, 0.0, 0.025], 4e-3), rng.normal(size=4))
    steps = pose.rotation[:, 0] * width / columns, pose.rotation[:, 2] * width / rows
    origin = pose.position - (columns - 1) / 2 * steps[0] - (rows - 1) / 2 * steps[1]
    return SlicePlane(origin, *steps, columns=columns, rows=rows)


def grey_by_scipy(volume, points):
    """Trilinear grey values at points (..., 3) m, held in the outer half voxel; 0 beyond."""
    index = points @ volume.patient_to_index[:3, :3].T + volume.patient_to_index[:3, 3]
    grey = map_coordinates(
        volume.intensities.astype(float), np.moveaxis(index, -1, 0), order=1, mode="nearest"
    )
    last = np.array(volume.shape) - 1
    within = ((index >= -0.5 - SLACK) & (index <= last + 0.5 + SLACK)).all(axis=-1)
    return np.where(within, grey, 0.0)


# --- the affine patch test ------------------------------------------------------------------------


@every_method
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_an_affine_deformation_gives_the_affinely_resampled_image(method, seed):
    """In every pixel: tissue, the rigid volume around it, and black where tissue moved away."""
    rng = np.random.default_rng(seed)
    mesh, volume, plane = box(rng.integers(2, 6, 3)), around_the_box(), random_plane(rng)
    matrix, shift = random_affine(rng)
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra)
    nodes = mesh.nodes @ matrix.T + shift

    pixels = plane.compute_pixel_positions()
    rest = (pixels - shift) @ np.linalg.inv(matrix).T
    is_tissue = ((rest >= LOW) & (rest <= HIGH)).all(axis=-1)
    was_tissue = ((pixels >= LOW) & (pixels <= HIGH)).all(axis=-1)
    expected = np.where(is_tissue[..., None], rest, pixels)
    expected[was_tissue & ~is_tissue] = np.nan
    found = slicer.compute_rest_coordinates(nodes, plane)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5)  # a hundredth of a voxel

    grey = np.floor(np.nan_to_num(grey_by_scipy(volume, expected)) + 0.5)
    assert np.abs(slicer.cut_image(nodes, plane) - grey).max() <= 1
    assert slicer.skipped == 0


# --- conservation: areas known from geometry ------------------------------------------------------


def labelled(inside, step=5e-4):
    """A volume of the box's size with label 1 where ``inside(x, y, z)`` holds."""
    counts = np.round((HIGH - LOW) / step).astype(int)
    centres = [low + step * (np.arange(n) + 0.5) for low, n in zip(LOW, counts, strict=True)]
    labels = inside(*np.meshgrid(*centres, indexing="ij", sparse=True)).astype(np.uint8)
    to_patient = np.diag([step, step, step, 1.0])
    to_patient[:3, 3] = LOW + step / 2
    return Volume(labels, to_patient, labels, {1: "inclusion"})


@every_method
@pytest.mark.parametrize("seed", range(3))
def test_a_ball_under_an_affine_map_has_the_area_of_the_ellipse(method, seed):
    rng = np.random.default_rng(seed)
    centre, radius = np.array([1e-3, -2e-3, 0.024]), 0.011
    volume = labelled(
        lambda x, y, z: (
            (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2 <= radius**2
        )
    )
    mesh, plane = box((5, 4, 5)), random_plane(rng, columns=180, rows=170)
    matrix, shift = random_affine(rng)
    # |B u + d| <= radius is an ellipse in the pixels' coordinates u.
    inverse = np.linalg.inv(matrix)
    pixel = inverse @ np.column_stack([plane.column_step, plane.row_step])
    offset = inverse @ (plane.origin - shift) - centre
    gram = pixel.T @ pixel
    distance2 = offset @ offset - offset @ pixel @ np.linalg.solve(gram, pixel.T @ offset)
    reach2 = radius**2 - distance2
    assert reach2 > (0.2 * radius) ** 2
    minor, major = np.sqrt(reach2 / np.linalg.eigvalsh(gram))[::-1]
    area, perimeter = np.pi * major * minor, np.pi * np.hypot(major, minor) * np.sqrt(2)
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra)
    found = slicer.cut_labels(mesh.nodes @ matrix.T + shift, plane).sum()
    assert abs(found - area) <= perimeter
    assert abs(found - area) <= 0.02 * area + 5


def vessel(x, y, z, radius=0.01, depth=0.02):
    """A cylinder along y."""
    return (x**2 + (z - depth) ** 2 <= radius**2) & (y < 1.0)


@every_method
def test_a_vessel_pressed_more_near_the_skin_loses_the_area_that_the_map_takes(method):
    mesh, volume = box((9, 2, 26)), labelled(vessel)
    plane = LinearProbe(0.06, 0.05, 240, 200).make_plane(Pose([0, 1e-3, 0]))

    def squeezed(z):
        return z + 0.012 * (1 - z / SIZE[2]) ** 2

    nodes = mesh.nodes.copy()
    nodes[:, 2] = squeezed(nodes[:, 2])
    area, _ = quad(
        lambda z: 2 * np.sqrt(0.01**2 - (z - 0.02) ** 2)
        * (1 - 2 * 0.012 / SIZE[2] * (1 - z / SIZE[2])),
        0.01, 0.03,
    )  # fmt: skip
    perimeter = 2 * np.pi * 0.01 / 0.00025
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra)
    assert abs(slicer.cut_labels(nodes, plane).sum() - area / 0.00025**2) <= perimeter / 4


# --- symmetry -------------------------------------------------------------------------------------


@pytest.mark.slow
@every_method
@pytest.mark.parametrize("kind", KINDS)
def test_threads_do_not_change_a_byte(method, kind):
    for seed in range(4):
        rest, tetrahedra, nodes, plane, volume = random_case(kind, seed)
        one, *more = (
            create_slicer(method, volume, rest, tetrahedra, threads=n) for n in (1, 2, 3, 64)
        )
        image, labels = one.cut_image(nodes, plane), one.cut_labels(nodes, plane)
        for slicer in more:
            np.testing.assert_array_equal(slicer.cut_image(nodes, plane), image)
            np.testing.assert_array_equal(slicer.cut_labels(nodes, plane), labels)
            assert slicer.skipped == one.skipped


# --- the surface belongs to the tissue ------------------------------------------------------------


@every_method
@pytest.mark.parametrize(
    ("corners", "count"),
    [
        ([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4]], 15),  # a face: 5 + 4 + 3 + 2 + 1 pixels
        ([[0, 0, 0], [0, -4, 0], [4, 0, 0], [0, 0, 4]], 15),  # the same from the other side
        ([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 4, 4]], 5),  # an edge along the first row
        ([[0, 0, 4], [4, 0, 0], [0, -4, 0], [-4, -4, 0]], 5),  # an edge across the pixels
        ([[0, 0, 0], [4, 4, 0], [0, 4, 0], [0, 4, 4]], 1),  # a corner
        ([[7, 0, 7], [4, -4, 0], [0, -4, 4], [0, -4, 0]], 1),  # one in the image's last pixel
        ([[0, 4, 0], [0, -4, 0], [4, 0, 0], [0, 0, 4]], 15),  # cut through two of its edges
    ],
)
def test_what_just_touches_the_plane_is_shown(method, corners, count):
    """Pixels lie exactly on corners and edges, in the plane and in rows and columns."""
    nodes = 1e-3 * np.array(corners, dtype=float)
    rest = 1e-3 * np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4]]) + [0.0, 1.0, 0.0]
    if np.linalg.det(nodes[1:] - nodes[0]) < 0:
        nodes[2:] = nodes[:1:-1]
    slicer = create_slicer(method, around_the_box(), rest, np.array([[0, 1, 2, 3]]))
    steps = np.array([1e-3, 0, 0]), np.array([0, 0, 1e-3])
    for turn in (Pose(), Pose([0.013, -0.007, 0.021], [0.3, -0.2, 0.5, 0.8])):
        plane = SlicePlane(
            turn.position, *(turn.rotation @ step for step in steps), columns=8, rows=8
        )
        found = slicer.compute_rest_coordinates(turn.transform_points(nodes), plane)
        assert (found[..., 1] > 0.5).sum() == count
        off = turn.rotation @ [0.0, 1e-8, 0.0]
        beside = SlicePlane(
            turn.position + off, *(turn.rotation @ step for step in steps), columns=8, rows=8
        )
        below = slicer.compute_rest_coordinates(turn.transform_points(nodes), beside)[..., 1] > 0.5
        if (nodes[:, 1] <= 0).all():
            assert not below.any()


# --- what cannot be shown -------------------------------------------------------------------------


@every_method
def test_inverted_and_flat_tetrahedra_are_left_out_and_counted(method):
    mesh, volume = box_mesh([-0.02, 0.02], [-0.02, 0.02], [0.0, 0.04]), around_the_box()
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra)
    plane = LinearProbe(0.03, 0.03, 40, 40).make_plane(Pose([0, 1e-3, 5e-3]))
    assert np.isfinite(slicer.compute_rest_coordinates(mesh.nodes, plane)).all()
    assert slicer.skipped == 0
    # All five, of which the plane meets each: black, since they covered the plane at rest.
    mirrored = mesh.nodes * [1.0, 1.0, -1.0] + [0, 0, 0.04]
    assert not slicer.cut_image(mirrored, plane).any()
    assert slicer.skipped >= 3
    assert not slicer.cut_image(mesh.nodes * [1.0, 0.0, 1.0] + [0, 1e-3, 0], plane).any()
    assert slicer.skipped == 5
    assert np.isnan(slicer.compute_rest_coordinates(mirrored, plane)).all()


@every_method
def test_only_the_inverted_tetrahedron_is_lost(method):
    """Two tetrahedra on one face: the apex of one is pushed through, so the other stays alone."""
    rest = np.array([[0.0, -0.01, 0.01], [-0.01, 0.01, 0.01], [0.01, 0.01, 0.01], [0, 0, 0.03],
                     [0, 0, -0.005]])  # fmt: skip
    tetrahedra = np.array([[0, 1, 2, 3], [0, 1, 2, 4]])
    volume = around_the_box()
    slicer = create_slicer(method, volume, rest, tetrahedra)
    plane = LinearProbe(0.01, 0.024, 41, 97).make_plane(Pose([0, 1e-3, 0.0]))
    nodes = rest.copy()
    nodes[4] = [0, 0, 0.014]
    alone = create_slicer(method, volume, rest, tetrahedra[:1])
    below = plane.compute_pixel_positions()[:, 0, 2] > 0.01 + 1e-9
    assert below.any()
    assert not below.all()
    both, one = (
        slicer.compute_rest_coordinates(nodes, plane),
        alone.compute_rest_coordinates(rest, plane),
    )
    np.testing.assert_allclose(both[below], one[below], rtol=0, atol=2e-5)
    assert (slicer.skipped, alone.skipped) == (1, 0)
    inside_lost = np.abs(plane.compute_pixel_positions()[..., 0]) < 5e-4
    inside_lost &= (plane.compute_pixel_positions()[..., 2] > 5e-3) & ~below[:, None]
    assert inside_lost.any()
    assert np.isnan(both[inside_lost]).all()


@every_method
def test_a_probe_outside_sees_nothing_and_a_plane_that_misses_sees_the_rigid_volume(method):
    mesh, volume = box((5, 4, 5)), around_the_box()
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra)
    nodes = mesh.nodes * [1.0, 1.0, 0.9]
    probe = LinearProbe(0.04, 0.04, 32, 48)
    far = probe.make_plane(Pose([0.5, 0.3, -0.4], [0.1, 0.2, 0.3, 1.0]))
    assert not slicer.cut_image(nodes, far).any()
    assert not slicer.cut_labels(nodes, far).any()
    np.testing.assert_allclose(
        slicer.compute_rest_coordinates(nodes, far), far.compute_pixel_positions(), atol=1e-12
    )
    beside = probe.make_plane(Pose([0, SIZE[1] / 2 + 0.004, 0.005]))
    assert slicer.cut_image(nodes, beside).any()
    rigid = sample_plane(volume, beside).astype(int)
    assert np.abs(slicer.cut_image(nodes, beside) - rigid).max() <= 1
    np.testing.assert_array_equal(slicer.cut_labels(nodes, beside), sample_labels(volume, beside))
    assert slicer.skipped == 0


@every_method
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nodes_that_are_not_finite_are_refused_and_the_next_good_frame_is_right(method, value):
    mesh, volume, plane = box((5, 4, 5)), around_the_box(), random_plane(np.random.default_rng(2))
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra, threads=2)
    nodes = mesh.nodes * [1.0, 1.1, 0.9]
    before, where = slicer.cut_image(nodes, plane), slicer.compute_rest_coordinates(nodes, plane)
    broken = nodes.copy()
    broken[7, 1] = value
    for cut in (slicer.cut_image, slicer.cut_labels, slicer.compute_rest_coordinates):
        with pytest.raises(MeshError, match="node 7 is not finite"):
            cut(broken, plane)
        with pytest.raises(MeshError, match=f"4 deformed nodes but {len(nodes)} at rest"):
            cut(nodes[:4], plane)
    np.testing.assert_array_equal(slicer.cut_image(nodes, plane), before)
    np.testing.assert_array_equal(slicer.compute_rest_coordinates(nodes, plane), where)
    assert slicer.skipped == 0


@every_method
@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "words"),
    [
        (np.full((4, 3), np.inf), [[0, 1, 2, 3]], "node 0"),
        (np.eye(4)[:, :3], [[0, 1, 2, 4]], "4 nodes"),
        (np.eye(4)[:, :3], [[0, 1, 2, -1]], "-1"),
    ],
)
def test_a_rest_mesh_that_cannot_be_is_refused(method, nodes, tetrahedra, words):
    with pytest.raises(MeshError, match=words):
        create_slicer(method, around_the_box(), nodes, np.array(tetrahedra))


@every_method
def test_nodes_out_of_all_proportion_do_no_harm(method):
    """A solver that has blown up, but not to infinity: no crash, and the next frame is right."""
    mesh, volume, plane = box((5, 4, 5)), around_the_box(), random_plane(np.random.default_rng(4))
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra)
    before = slicer.cut_image(mesh.nodes, plane)
    for scale in (1e6, 1e30, 1e150):
        nodes = mesh.nodes.copy()
        nodes[::3] *= scale
        assert slicer.cut_image(nodes, plane).shape == before.shape
    np.testing.assert_array_equal(slicer.cut_image(mesh.nodes, plane), before)


# --- volumes of any size --------------------------------------------------------------------------


@every_method
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 5, 4), (4, 1, 5), (3, 4, 1)])
def test_a_volume_of_one_voxel_is_held_up_to_its_faces(method, shape):
    """One voxel along an axis has one value from face to face, and the mesh goes beyond them."""
    step = 0.024 / np.array(shape)
    volume = noise_volume(shape, step, (-0.012, -0.012, 0.012), seed=5)
    mesh = box((3, 3, 3))
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra)
    rng = np.random.default_rng(6)
    for _ in range(5):
        matrix, shift = random_affine(rng)
        plane = random_plane(rng)
        nodes = mesh.nodes @ matrix.T + shift
        rest = slicer.compute_rest_coordinates(nodes, plane)
        index = rest @ volume.patient_to_index[:3, :3].T + volume.patient_to_index[:3, 3]
        last = np.array(shape) - 1
        beyond = np.maximum(-0.5 - index, index - last - 0.5).max(axis=-1)
        inside = beyond < 0
        held = np.clip(np.nan_to_num(index), 0, last)
        grey = map_coordinates(volume.intensities.astype(float), np.moveaxis(held, -1, 0), order=1)
        image, labels = slicer.cut_image(nodes, plane), slicer.cut_labels(nodes, plane)
        clear = ~(np.abs(beyond) < 1e-3)
        assert inside.sum() > 50
        assert np.abs(image - np.floor(grey * inside + 0.5))[clear].max() <= 1
        nearest = volume.labels[tuple(np.moveaxis(np.floor(held + 0.5).astype(int), -1, 0))]
        ties = (np.abs(held % 1.0 - 0.5) < 1e-3).any(axis=-1)
        np.testing.assert_array_equal(labels[clear & ~ties], (nearest * inside)[clear & ~ties])


_LARGE = """
import sys
import numpy as np
from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

step = 2e-4
voxels = np.full((512, 512, 512), 200, dtype=np.uint8)
voxels[:256] = 100
to_patient = np.diag([step, step, step, 1.0])
to_patient[:3, 3] = [-256 * step, -256 * step, 0.0]
volume = Volume(voxels, to_patient, voxels)
mesh = box_mesh(*(uniform_planes(-0.05, 0.05, n) for n in (20, 10)), uniform_planes(0, 0.1, 10))
slicer = create_slicer(sys.argv[1], volume, mesh.nodes, mesh.tetrahedra, threads=2)
plane = LinearProbe(0.05, 0.05, 512, 512).make_plane(Pose([0, 1e-3, 0.01]))
nodes = mesh.nodes * [1, 1, 0.9] + [0, 0, 0.01]
image, labels = slicer.cut_image(nodes, plane), slicer.cut_labels(nodes, plane)
assert (image[:, :250] == 100).all() and (image[:, 262:] == 200).all()
assert (labels[:, :250] == 100).all() and (labels[:, 262:] == 200).all()
with open("/proc/self/status") as lines:  # getrusage counts the peak of who started this, too
    peak = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
print(peak - voxels.nbytes)
"""


def _free_memory():
    """B, or what Linux says; plenty where it says nothing."""
    try:
        with open("/proc/meminfo") as lines:
            return next(int(line.split()[1]) * 1024 for line in lines if "MemAvailable" in line)
    except OSError:
        return 1 << 40


@pytest.mark.slow
@every_method
def test_a_volume_of_512_voxels_a_side_takes_its_own_size_and_300_megabytes(method):
    if not Path("/proc/self/status").exists():
        pytest.skip("the operating system does not tell the peak of memory")
    if _free_memory() < 1 << 30:
        pytest.skip("less than 1 GB of memory is free, which a 512³ volume and its slicer may need")
    done = subprocess.run(
        [sys.executable, "-c", _LARGE, method],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=Path(__file__).parents[3],
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 300e6
