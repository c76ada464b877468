"""Centre lines and sections of known tubes, at rest and carried."""

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tubes import RADIUS, SIDES, around, block, grid, tube_volume

from us_sim.errors import VolumeError
from us_sim.slicing.flow.lumen import find_centreline, measure_lumen
from us_sim.slicing.flow.vessel import CarriedLumen

MIDDLE = np.array([0.0, 0.0, 0.5 * SIDES[2]])


def lumen_in(volume):
    return measure_lumen(volume.labels == 1, volume.index_to_patient)


@pytest.mark.parametrize(
    ("radius", "direction"), [(2e-3, (0.25, 1, -0.15)), (3e-3, (0, 1, 0)), (5e-3, (0.25, 1, -0.15))]
)
def test_sections_of_a_cylinder_have_its_area_across_it(radius, direction):
    volume = tube_volume(radius, direction)
    lumen = lumen_in(volume)
    inner = slice(2, -2)
    unit = np.array(direction) / np.linalg.norm(direction)
    of_voxels = volume.labels.sum() * (5e-4) ** 3 * unit[1] / SIDES[1]
    assert lumen.areas[inner].mean() == pytest.approx(of_voxels, rel=0.015)
    assert lumen.areas[inner] == pytest.approx(np.pi * radius**2, rel=0.06)  # of few voxels
    assert np.abs(lumen.tangents[inner] @ unit).min() > 0.995
    frames = np.concatenate([lumen.tangents[:, None], lumen.across], axis=1)
    assert np.allclose(frames @ frames.transpose(0, 2, 1), np.eye(3), atol=1e-12)


def test_places_are_along_the_tube_and_radial_coordinates_as_in_a_cylinder():
    lumen = lumen_in(tube_volume())
    random = np.random.default_rng(3)
    angle, part = random.uniform(0, 2 * np.pi, 200), random.uniform(0.05, 1.3, 200)
    along = random.uniform(-15e-3, 15e-3, 200)
    points = np.column_stack([3e-3 * part * np.cos(angle), along, 3e-3 * part * np.sin(angle)])
    station, offset = lumen.locate_points(points + MIDDLE)
    assert np.hypot(*offset.T) == pytest.approx(part, rel=0.06)
    forward = np.sign(lumen.centres[-1, 1] - lumen.centres[0, 1])
    place = lumen.centres[0, 1] + forward * station * lumen.spacing
    assert place == pytest.approx(along, abs=0.3e-3)


def test_what_its_sections_do_not_hold_is_no_tube():
    """A tube with a wide thin fin, which a star cannot reach around the corner of."""
    places, to_patient = grid()
    x, _, z = np.moveaxis(places - MIDDLE, -1, 0)
    tube = np.hypot(x, z) < 1.6e-3
    fin = (np.abs(x - 1e-3) < 0.6e-3) & (z > 0) & (z < 8e-3)
    hook = (x > 0.4e-3) & (x < 7e-3) & (np.abs(z - 8e-3) < 0.6e-3)
    with pytest.raises(VolumeError, match=r"is no tube: |is too short"):
        measure_lumen(tube | fin | hook, to_patient)


@st.composite
def shapes(draw):
    """Boxes and balls in a small volume, one voxel and none included."""
    lumen = np.zeros((14, 30, 12), bool)
    for _ in range(draw(st.integers(0, 4))):
        low = [draw(st.integers(0, side - 1)) for side in lumen.shape]
        high = [draw(st.integers(a + 1, side)) for a, side in zip(low, lumen.shape, strict=True)]
        lumen[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] ^= draw(st.booleans())
    if draw(st.booleans()):
        centre = [draw(st.integers(0, side)) for side in lumen.shape]
        away = np.linalg.norm(np.moveaxis(np.indices(lumen.shape), 0, -1) - centre, axis=-1)
        lumen |= away < draw(st.floats(0.5, 6.0))
    return lumen


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(shapes(), st.floats(0.2, 5.0), st.floats(0.2, 5.0))
def test_any_shape_is_a_tube_or_is_refused(lumen, one, other):
    try:
        found = measure_lumen(lumen, np.diag([1e-3, one * 1e-3, other * 1e-3, 1.0]))
    except VolumeError:
        return
    assert np.isfinite(found.radii).all()
    assert (found.radii > 0.0).all()
    assert len(found.centres) >= 2
    station, offset = found.locate_points(found.centres)
    assert np.isfinite(station).all()
    assert np.abs(offset).max() < 0.2


def refusal(lumen, to_patient=None):
    with pytest.raises(VolumeError) as caught:
        find_centreline(lumen, np.eye(4) if to_patient is None else to_patient)
    return str(caught.value)


@pytest.mark.parametrize("direction", [(0, 1, 0), (0.3, 1, -0.2), (0.2, -1, 0.3)])
def test_it_lies_in_the_middle_of_a_straight_tube(direction):
    places, to_patient = grid()
    middle = np.array([0.0, 0.0, 0.5 * SIDES[2]])
    line = find_centreline(around(places, middle, direction), to_patient)
    unit = np.array(direction) / np.linalg.norm(direction)
    offset = line.points - middle
    across = np.linalg.norm(offset - np.outer(offset @ unit, unit), axis=1)
    assert across[3:-3].max() < 0.1 * RADIUS  # the ends are cut obliquely
    assert across.max() < 0.4 * RADIUS
    assert np.ptp(offset @ unit) > 0.7 * SIDES[1]
    assert line.width == pytest.approx(2 * RADIUS, rel=0.1)


def test_it_follows_a_bend():
    """A quarter of a ring of radius 15 mm, and 2.5 mm thick."""
    places, to_patient = grid(sides=(40e-3, 40e-3, 10e-3))
    x, y, z = np.moveaxis(places - [-20e-3, -20e-3, 5e-3], -1, 0)
    lumen = np.hypot(np.hypot(x, y) - 15e-3, z) < 2.5e-3
    points = find_centreline(lumen, to_patient).points - [-20e-3, -20e-3, 5e-3]
    assert np.abs(np.hypot(points[:, 0], points[:, 1]) - 15e-3).max() < 0.5e-3
    angles = np.arctan2(points[:, 1], points[:, 0])
    assert np.ptp(angles) > np.radians(65)


def test_shapes_that_are_no_tubes_are_refused_with_the_reason():
    assert refusal(np.zeros((5, 5, 5), bool)) == "is nowhere in the volume"
    places, to_patient = grid()
    ball = np.linalg.norm(places - [0, 0, 0.01], axis=-1) < 5e-3
    assert refusal(ball, to_patient).startswith("is too short for a tube: 1")
    x, y, z = np.moveaxis(places, -1, 0)
    stem = around(places, (0, 0, 0.01), (0, 1, 0), 2e-3) & (y < 0)
    fork = stem | (np.hypot(np.abs(x) - 0.4 * y, z - 0.01) < 2e-3) & (y >= 0)
    assert refusal(fork, to_patient).startswith("branches near (")
    apart = around(places, (0, 0, 0.01), (0, 1, 0), 2e-3) & (np.abs(y) > 3e-3)
    assert refusal(apart, to_patient) == "is in 2 pieces"


@pytest.fixture(scope="module")
def tube():
    volume = tube_volume()
    return measure_lumen(volume.labels == 1, volume.index_to_patient)


@pytest.fixture(scope="module")
def carried(tube):
    return CarriedLumen(tube, block())


@settings(deadline=None, max_examples=30)
@given(stretch=arrays.arrays(float, (3, 3), elements=st.floats(-0.3, 0.3)))
def test_a_homogeneous_deformation_changes_areas_as_nanson_says(tube, carried, stretch):
    """n' A' = det(F) F^-T n A, of which the flow sees what is along the carried tangent."""
    deformation = np.eye(3) + stretch
    now = carried.deform_lumen(block().nodes @ deformation.T)
    along = tube.tangents @ deformation.T
    lengths = np.linalg.norm(along, axis=1)
    expected = tube.areas * np.linalg.det(deformation) / lengths
    # Tangents are differences between stations, so that the bends of a voxelled line turn a little.
    assert now.areas == pytest.approx(expected, rel=0.03)
    assert now.filled == pytest.approx(0.5 * now.areas, rel=1e-6)
    assert np.einsum("sx,sx->s", now.tangents, along / lengths[:, None]).min() > 0.99


def test_a_lumen_that_is_turned_inside_out_is_empty(carried):
    nodes = block().nodes * [1.0, 1.0, -1.0]
    now = carried.deform_lumen(nodes)
    assert (now.areas == 0.0).all()
    assert (now.filled == 0.0).all()
