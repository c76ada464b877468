"""The transducer to look at: closed parts, on the collider where it presses, of known volumes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.collider_distance import measure_distances
from us_sim.geometry.pose import Pose
from us_sim.geometry.transducer import build_transducer_mesh
from us_sim.volume.surfaces.label_surface import compute_enclosed_volume

LINEAR = RoundedBox(length=0.046, width=0.014, height=0.040, rounding=0.004)
CURVED = Convex(radius=0.0508, length=0.062, width=0.018, height=0.060, rounding=0.006)
PHASED = RoundedBox(length=0.021, width=0.015, height=0.040, rounding=0.003)
COLLIDERS = [LINEAR, CURVED, PHASED, Sphere(0.02), Capsule(radius=0.01, length=0.03)]
NOSE = 0.006
"""m, how far a face goes straight back behind its rounding."""


@pytest.mark.parametrize("collider", COLLIDERS, ids=lambda c: type(c).__name__)
def test_every_part_is_closed_and_faces_outwards(collider):
    for part in build_transducer_mesh(collider):
        edges = np.sort(part.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all(), part.name
        joined = coo_array((np.ones(len(edges)), edges.T), shape=(len(part.vertices),) * 2)
        assert connected_components(joined)[0] == 1, part.name
        assert compute_enclosed_volume(part.vertices, part.triangles) > 0, part.name


@pytest.mark.parametrize("collider", COLLIDERS, ids=lambda c: type(c).__name__)
def test_the_face_lies_on_what_presses(collider):
    face = build_transducer_mesh(collider)[0].vertices
    front = face[face[:, 2] > face[:, 2].min() + 1e-6]
    distance, _ = measure_distances(collider, Pose(), front)
    assert len(front) > 100
    assert np.abs(distance).max() < 1e-12
    assert front[:, 2].max() == pytest.approx(0.0, abs=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.005, 0.05), st.floats(0.002, 0.02), st.floats(0.001, 0.004))
def test_the_faces_volume_is_that_of_a_rounded_box(length, width, rounding):
    collider = RoundedBox(
        length=length + 2 * rounding, width=width + 2 * rounding, height=0.05, rounding=rounding
    )
    face = build_transducer_mesh(collider)[0]
    base = length * width
    around = 2 * (length + width)
    # The core's column, half cylinders' halves along its edges, and a half sphere at its corners.
    rounded = base * rounding + around * math.pi / 4 * rounding**2 + 2 / 3 * math.pi * rounding**3
    straight = NOSE * (base + around * rounding + math.pi * rounding**2)
    volume = compute_enclosed_volume(face.vertices, face.triangles)
    # What is round is made of chords, so it is a little less.
    assert 0.985 * (rounded + straight) < volume <= rounded + straight


def test_the_notch_is_on_the_side_of_the_images_first_column():
    *_, notch = build_transducer_mesh(LINEAR)
    assert notch.name == "notch"
    assert notch.vertices[:, 0].max() < 0.0
    assert notch.vertices[:, 1].mean() == pytest.approx(0.0, abs=1e-9)
