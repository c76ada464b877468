"""Fast slicing methods against the location of every pixel on its own, on random cases."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from slicing_cases import KINDS, random_case

from us_sim.slicing.slicer import create_slicer

CASES = {"scan_conversion": 130, "row_subdivision": 25}
"""How many of each kind; the same ones always, since a pixel may lie within rounding of an edge."""

_CLOSE = 0.1
"""Voxels by which a place at rest may be off."""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("method", CASES)
def test_a_method_equals_the_location_of_every_pixel(method, kind):
    @settings(max_examples=CASES[method], deadline=None, derandomize=True)
    @given(seed=st.integers(0, 2**32 - 1), threads=st.integers(1, 3))
    def agree(seed, threads):
        case = random_case(kind, seed)
        assert_agreement(case, method, threads)

    agree()


def assert_agreement(case, method, threads):
    """Coverage, places at rest, grey values and labels are those of the oracle.

    Where tetrahedra overlap, a pixel must agree with one of those that hold it.
    """
    _, _, nodes, plane, volume = case
    oracle = create_slicer("per_pixel", volume, *case[:2])
    slicer = create_slicer(method, volume, *case[:2], threads=threads)
    expected, found = (s.rest_coordinates(nodes, plane) for s in (oracle, slicer))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected), "coverage")
    assert slicer.skipped == oracle.skipped

    linear, shift = volume.patient_to_index[:3, :3], volume.patient_to_index[:3, 3]
    index, place = (rest @ linear.T + shift for rest in (found, expected))
    off = np.linalg.norm(index - place, axis=-1)
    image, labels = slicer.image(nodes, plane), slicer.labels(nodes, plane)
    differs = np.abs(image.astype(int) - oracle.image(nodes, plane)) > 1
    differs |= (labels != oracle.labels(nodes, plane)) & ~between_voxels(place)
    suspect = differs | (off > _CLOSE)
    if suspect.any():
        holders, places = tetrahedra_at(case, plane.pixels()[suspect])
        index_there = places @ linear.T + shift
        near = np.linalg.norm(index_there - index[suspect][:, None], axis=-1) <= _CLOSE
        grey, label = sampled(volume, index_there)
        same = np.abs(image[suspect][:, None] - grey) <= 1
        same &= (labels[suspect][:, None] == label) | between_voxels(index_there)
        assert (holders.sum(axis=1) >= 2).all(), "a pixel differs where only one tetrahedron is"
        assert (holders & near & same).any(axis=1).all(), "a pixel is of no tetrahedron there"


def tetrahedra_at(case, points, slack=1e-7):
    """Which valid tetrahedra hold points (P, 3): (P, M), and the places at rest (P, M, 3) m."""
    now, rest = case.nodes[case.tetrahedra], case.rest_nodes[case.tetrahedra]
    edges, rest_edges = now[:, 1:] - now[:, :1], rest[:, 1:] - rest[:, :1]
    size, rest_size = np.linalg.det(edges), np.linalg.det(rest_edges)
    valid = size * np.sign(rest_size) > 1e-6 * np.abs(rest_size)
    edges[~valid] = np.eye(3)
    inverse = np.linalg.inv(edges)
    weights = np.einsum("pmj,mjk->pmk", points[:, None] - now[:, 0], inverse)
    inside = (weights >= -slack).all(axis=-1) & (weights.sum(axis=-1) <= 1 + slack) & valid
    return inside, rest[:, 0] + np.einsum("pmk,mkj->pmj", weights, rest_edges)


def between_voxels(index):
    """Whether an index (..., 3) lies as near to one voxel's centre as to another's: no matter."""
    return (np.abs(index % 1.0 - 0.5) < 1e-3).any(axis=-1)


def sampled(volume, index):
    """Grey values by scipy and the nearest labels at ``index`` (..., 3), 0 beyond the volume."""
    last = np.array(volume.shape) - 1
    within = ((index >= -0.5 - 1e-6) & (index <= last + 0.5 + 1e-6)).all(axis=-1)
    held = np.where(within[..., None], np.clip(index, 0, last), 0.0)
    grey = map_coordinates(volume.intensities.astype(float), np.moveaxis(held, -1, 0), order=1)
    label = volume.labels[tuple(np.moveaxis(np.floor(held + 0.5).astype(int), -1, 0))]
    return np.floor(grey + 0.5) * within, label * within
