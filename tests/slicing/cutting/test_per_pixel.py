"""Locating every pixel, against numbers by hand, linear algebra and SciPy; and fast methods
against it.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slicing_cases import KINDS, between_voxels, random_case, sampled, tetrahedra_at

from us_sim.slicing.cutting.per_pixel import PerPixel
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.volume.volume import Volume

# One tetrahedron with its corners at the origin and 4 mm along each axis.
CORNER = np.array([[0.0, 0, 0], [4e-3, 0, 0], [0, 4e-3, 0], [0, 0, 4e-3]])
ONE = np.array([[0, 1, 2, 3]])


def millimetres(columns, rows, y=0.0, spans=None):
    """Pixels of 1 mm in the plane of x and z, the first at x = z = 0."""
    return SlicePlane(
        np.array([0.0, y, 0.0]), np.array([1e-3, 0, 0]), np.array([0, 0, 1e-3]),
        columns=columns, rows=rows, spans=spans,
    )  # fmt: skip


def ramp():
    """The grey value of voxel (i, j, k), 1 mm wide, is 100 + 10 i + k."""
    voxels = np.add.outer(np.add.outer(10 * np.arange(8), np.zeros(8, int)), np.arange(8)) + 100
    return Volume(voxels.astype(np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1.0]), voxels.astype("u1"))


def test_only_spans_are_shown():
    spans = np.array([[[0, 2], [5, 8]], [[3, 3], [0, 0]]], dtype=np.int32)
    plane = millimetres(8, 2, spans=spans)
    image = PerPixel(ramp(), CORNER, ONE).cut_image(CORNER, plane)
    np.testing.assert_array_equal(image, [[100, 110, 0, 0, 0, 150, 160, 170], [0] * 8])


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=6, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_pixel_is_where_linear_algebra_puts_it(kind, seed):
    case = random_case(kind, seed)
    slicer = PerPixel(case.volume, case.rest_nodes, case.tetrahedra, threads=2)
    rest = slicer.compute_rest_coordinates(case.nodes, case.plane).reshape(-1, 3)
    points = case.plane.compute_pixel_positions().reshape(-1, 3)
    shown = case.plane.make_shown_mask().ravel()
    holders, places = tetrahedra_at(case, points, 1e-9)
    was_tissue = tetrahedra_at(case._replace(nodes=case.rest_nodes), points, 1e-9)[0].any(axis=1)
    is_tissue = holders.any(axis=1)
    np.testing.assert_array_equal(np.isnan(rest[:, 0]), ~shown | (was_tissue & ~is_tissue))
    rigid = shown & ~was_tissue & ~is_tissue
    np.testing.assert_allclose(rest[rigid], points[rigid], rtol=0, atol=1e-15)
    tissue = shown & is_tissue
    distances = np.linalg.norm(places[tissue] - rest[tissue][:, None], axis=-1)
    assert np.where(holders[tissue], distances, np.inf).min(axis=1).max(initial=0.0) < 1e-9

    index = rest @ case.volume.patient_to_index[:3, :3].T + case.volume.patient_to_index[:3, 3]
    somewhere = ~np.isnan(rest[:, 0])
    grey, label = sampled(case.volume, index[somewhere])
    image = slicer.cut_image(case.nodes, case.plane).ravel()
    labels = slicer.cut_labels(case.nodes, case.plane).ravel()
    assert np.abs(image[somewhere] - grey).max(initial=0) <= 1
    clear = ~between_voxels(index[somewhere])
    np.testing.assert_array_equal(labels[somewhere][clear], label[clear])
    assert not image[~somewhere].any()
    assert not labels[~somewhere].any()


_CLOSE = 0.1
"""Voxels by which a place at rest may be off."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=80, deadline=None, derandomize=True)  # a pixel may lie on an edge
@given(seed=st.integers(0, 2**32 - 1), threads=st.integers(1, 3))
def test_scan_conversion_equals_the_location_of_every_pixel(kind, seed, threads):
    """Coverage, places at rest, grey values and labels are those of the oracle.

    Where tetrahedra overlap, a pixel must agree with one of those that hold it.
    """
    case = random_case(kind, seed)
    _, _, nodes, plane, volume = case
    oracle = create_slicer("per_pixel", volume, *case[:2])
    slicer = create_slicer("scan_conversion", volume, *case[:2], threads=threads)
    expected, found = (s.compute_rest_coordinates(nodes, plane) for s in (oracle, slicer))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected), "coverage")
    assert slicer.skipped == oracle.skipped

    linear, shift = volume.patient_to_index[:3, :3], volume.patient_to_index[:3, 3]
    index, place = (rest @ linear.T + shift for rest in (found, expected))
    off = np.linalg.norm(index - place, axis=-1)
    image, labels = slicer.cut_image(nodes, plane), slicer.cut_labels(nodes, plane)
    differs = np.abs(image.astype(int) - oracle.cut_image(nodes, plane)) > 1
    differs |= (labels != oracle.cut_labels(nodes, plane)) & ~between_voxels(place)
    suspect = differs | (off > _CLOSE)
    if suspect.any():
        holders, places = tetrahedra_at(case, plane.compute_pixel_positions()[suspect])
        index_there = places @ linear.T + shift
        near = np.linalg.norm(index_there - index[suspect][:, None], axis=-1) <= _CLOSE
        grey, label = sampled(volume, index_there)
        same = np.abs(image[suspect][:, None] - grey) <= 1
        same &= (labels[suspect][:, None] == label) | between_voxels(index_there)
        assert (holders.sum(axis=1) >= 2).all(), "a pixel differs where only one tetrahedron is"
        assert (holders & near & same).any(axis=1).all(), "a pixel is of no tetrahedron there"
