"""The exact slicer's kernels: every pixel once, places kept, spans, threads, memory."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slicing_cases import SIZE, box, plane_of_nodes

from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting import cut_polygons, resampling, section, span_sampling
from us_sim.slicing.cutting.resampling import sample_labels, sample_plane
from us_sim.slicing.cutting.scan_conversion import ScanConversion
from us_sim.slicing.cutting.slicer import warm_up
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.volume import Volume

COUNTS = (7, 5, 6)


def volume_around_the_box(voxel=1e-3, margin=0.01):
    shape = np.round((SIZE + 2 * margin) / voxel).astype(int)
    to_patient = np.diag([voxel, voxel, voxel, 1.0])
    to_patient[:3, 3] = -SIZE / 2 - margin + voxel / 2
    to_patient[2, 3] += SIZE[2] / 2
    voxels = np.random.default_rng(0).integers(1, 256, shape, dtype=np.uint8)
    return Volume(voxels, to_patient, (voxels // 64) + np.uint8(1), {1: "a"})


def times_written(slicer, nodes, plane):
    """(rows, columns) how many polygons hold each pixel, outlines left aside."""
    count, *_ = slicer._cut(nodes, plane)
    cuts = slicer._cuts
    found = np.empty((plane.rows, plane.columns), dtype=np.int64)
    used = np.empty(plane.rows, dtype=np.int32)
    cut_polygons.convert_cuts(
        cuts.corners, cuts.sides, count, cuts.outlines, cuts.points, cuts.owner, 0,
        slicer._shown(plane), 0, plane.rows, found, used,
    )  # fmt: skip
    written = np.zeros((plane.rows, plane.columns), dtype=int)
    for row in range(plane.rows):
        for span in found[row, : used[row]]:
            written[row, span & 8191 : span >> 13 & 8191] += 1
    return written


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_within_the_mesh_every_pixel_is_written_exactly_once(seed):
    rng = np.random.default_rng(seed)
    mesh = box(COUNTS)
    spacing = SIZE / [6, 4, 5]
    nodes = mesh.nodes + rng.uniform(-0.2, 0.2, mesh.nodes.shape) * spacing
    slicer = ScanConversion(volume_around_the_box(), mesh.nodes, mesh.tetrahedra)
    pose = Pose([0.0, 0.0, 0.015], rng.normal(size=4))
    plane = LinearProbe(0.01, 0.01, 113, 97).make_plane(pose)
    assert (times_written(slicer, nodes, plane) == 1).all()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("layer", [0, 2, -1])
@pytest.mark.parametrize("off", [0.0, -1e-12, 3e-10])
def test_on_nodes_edges_and_faces_nothing_is_written_twice(axis, layer, off):
    mesh = box(COUNTS)
    plane = plane_of_nodes(mesh, axis, layer)
    inwards = 1.0 if layer >= 0 else -1.0
    along = np.eye(3)[axis] * off * inwards * np.linalg.norm(plane.column_step)
    plane = SlicePlane(plane.origin + along, plane.column_step, plane.row_step, plane.columns,
                       plane.rows)  # fmt: skip
    slicer = ScanConversion(volume_around_the_box(), mesh.nodes, mesh.tetrahedra)
    written = times_written(slicer, mesh.nodes, plane)
    assert written.max() <= 1
    # Left and upper borders belong to the half-open polygons, right and lower ones to outlines.
    if 0 < layer < 3:
        assert (written[:-1, :-1] == 1).all()
    found = slicer.compute_rest_coordinates(1.0 * mesh.nodes, plane)
    np.testing.assert_allclose(found, plane.compute_pixel_positions(), rtol=0, atol=1e-9)


def test_a_fan_shows_what_the_full_image_shows_within_its_spans():
    mesh = box(COUNTS)
    full = LinearProbe(0.05, 0.04, 64, 50).make_plane(Pose([0.004, 0, 0.003], [0.1, 0.05, 0, 1]))
    rng = np.random.default_rng(1)
    edges = np.sort(rng.integers(0, 65, (50, 4)), axis=1).reshape(50, 2, 2).astype(np.int32)
    edges[3] = edges[7, 1] = 0
    fan = SlicePlane(full.origin, full.column_step, full.row_step, 64, 50, spans=edges)
    volume = volume_around_the_box()
    slicer = ScanConversion(volume, mesh.nodes, mesh.tetrahedra)
    nodes = mesh.nodes * [0.8, 1.0, 0.9]
    shown = fan.make_shown_mask()
    for draw in (
        lambda plane: slicer.cut_image(nodes, plane),
        lambda plane: slicer.cut_labels(nodes, plane),
        lambda plane: sample_plane(volume, plane, threads=2),
        lambda plane: sample_labels(volume, plane, threads=3),
    ):
        np.testing.assert_array_equal(draw(fan), np.where(shown, draw(full), 0))
    places = slicer.compute_rest_coordinates(nodes, fan)
    assert np.isnan(places[~shown]).all()
    np.testing.assert_array_equal(
        places[shown], slicer.compute_rest_coordinates(nodes, full)[shown]
    )


def test_grey_values_keep_within_a_level_along_the_longest_row():
    """A map over 4096 pixels through voxels that alternate between black and white."""
    voxels = np.zeros((64, 64, 64), dtype=np.uint8)
    voxels[(np.indices(voxels.shape).sum(axis=0) % 2).astype(bool)] = 255
    volume = Volume(voxels, np.diag([1e-3] * 3 + [1.0]))
    mesh = box_mesh([1e-3, 0.062], [1e-3, 0.062], [1e-3, 0.062])
    plane = SlicePlane([0.0015, 0.002, 0.0022], [1.4e-5, 9e-6, 1.2e-5], [1e-5, -3e-7, 1e-6],
                       columns=4096, rows=3)  # fmt: skip
    slicer = ScanConversion(volume, mesh.nodes, mesh.tetrahedra)
    index = plane.compute_pixel_positions() * 1e3
    expected = np.zeros(index.shape[:2])
    lower = np.floor(index).astype(int)
    way = index - lower
    for side in np.ndindex(2, 2, 2):
        weight = np.where(side, way, 1 - way).prod(axis=-1)
        expected += weight * voxels[tuple(np.moveaxis(lower + side, -1, 0))]
    found = slicer.cut_image(mesh.nodes, plane)
    assert np.abs(found - expected).max() < 0.5 + 0.2


def test_nothing_is_left_to_compile_after_warming_up():
    warm_up("scan_conversion")
    kernels = (
        section._near,
        cut_polygons.cut_tetrahedra,
        cut_polygons.convert_cuts,
        cut_polygons._cut,
        span_sampling.sample_spans,
        span_sampling.fill_elements,
        resampling.sample_nearest,
    )
    before = [len(kernel.signatures) for kernel in kernels]
    assert min(before) >= 1
    mesh = box(COUNTS)
    slicer = ScanConversion(volume_around_the_box(), mesh.nodes, mesh.tetrahedra, threads=2)
    plane = LinearProbe(0.08, 0.04, 30, 20).make_plane(Pose([0, 0, -1e-3]))
    slicer.cut_image(mesh.nodes * 1.1, plane)
    slicer.cut_labels(mesh.nodes, plane)
    slicer.compute_rest_coordinates(mesh.nodes, plane)
    assert [len(kernel.signatures) for kernel in kernels] == before
