"""Fast slicing methods against the location of every pixel on its own, on random cases."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slicing_cases import KINDS, between_voxels, random_case, sampled, tetrahedra_at

from us_sim.slicing.cutting.slicer import create_slicer

CASES = {"scan_conversion": 80, "row_subdivision": 20}
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
