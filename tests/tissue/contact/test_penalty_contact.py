"""Springs between points and a probe: forces are the slope of an energy."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.penalty_contact import PenaltyContact
from us_sim.tissue.contact.probe_gap import FlaredProbe

FINE, COARSE = 0.002, 0.012  # m, spacings that resolve the roundings below, and that do not
STIFF, STRONG, STIFFENING = 2e3, 20.0, 2e-3  # N/m, N and m of every spring
COLLIDERS = [
    Sphere(0.03),
    Capsule(0.03, 0.04),
    RoundedBox(0.05, 0.03, 0.06, 0.006),
    Convex(radius=0.055, length=0.076, width=0.036, height=0.06, rounding=0.01),
]
TURNED = Pose(np.array([0.1, -0.2, 0.3]), np.array([0.3, -0.2, 0.5, 0.8]))

colliders, spacings = st.sampled_from(COLLIDERS), st.sampled_from([FINE, COARSE])
shapes = st.builds(FlaredProbe, colliders, spacings)
lateral = st.floats(-0.04, 0.04)
places = st.lists(st.tuples(lateral, lateral, st.floats(-0.03, 0.005)), min_size=1, max_size=5).map(
    lambda where: np.round(where, 7)
)
moduli = st.floats(1.0, 1e5)
seeds = st.integers(0, 2**32 - 1)
EXAMPLES = settings(deadline=None, max_examples=100)


def contact_of(probe, count, stiffness=STIFF, strongest=STRONG):
    return PenaltyContact(
        probe, np.full(count, float(stiffness)), np.full(count, float(strongest)), STIFFENING
    )


def contact_at(probe, where, pose=TURNED):
    """A contact of points (P, 3) of the probe's frame, and these in the patient's."""
    positions = pose.transform_points(np.array(where, dtype=float))
    contact = contact_of(probe, len(positions))
    contact.set_pose(pose, positions)
    contact.drop_planes(positions)
    return contact, positions


def forces_around(contact, positions, step):
    """(2, 3, P, 3) N, forces with every point moved to and fro along each axis, and normals."""
    forces, normals = np.empty((2, 2, 3, *positions.shape))
    for k, sign in enumerate((1, -1)):
        for axis in range(3):
            contact.update_gaps(positions + sign * step * np.eye(3)[axis])
            forces[k, axis], normals[k, axis] = contact.force, contact.normal
    contact.update_gaps(positions)
    return forces, normals


@pytest.mark.slow
@EXAMPLES
@given(shapes, places)
def test_the_push_is_the_slope_of_the_energy(probe, where):
    contact, positions = contact_at(probe, where)
    force, step = contact.force.copy(), 1e-7
    for point in range(len(positions)):
        for axis in np.eye(3):
            moved, energy, normals = positions.copy(), [], []
            for sign in (1, -1):
                moved[point] = positions[point] + sign * step * axis
                contact.update_gaps(moved)
                energy.append(contact.energy)
                normals.append(contact.normal[point].copy())
            # Deep inside are creases where the nearest surface is another one.
            if np.abs(np.subtract(*normals)).max() < 1e-3:
                slope = (energy[0] - energy[1]) / (2 * step)
                assert slope == pytest.approx(-force[point] @ axis, abs=1e-3)


@EXAMPLES
@given(st.floats(-0.01, 0.01), moduli, moduli)
def test_the_push_rises_faster_and_faster_up_to_the_greatest(gap, stiff, strong):
    contact = contact_of(FlaredProbe(Sphere(0.03), COARSE), 1, stiff, strong)
    contact.set_pose(Pose(), np.array([[0.0, 0.0, gap]]))
    depth = max(0.0, -gap)
    law = stiff * depth * (1 + (depth / STIFFENING) ** 2)
    assert contact.normal_force[0] == pytest.approx(min(law, strong), rel=1e-9)


@EXAMPLES
@given(colliders, spacings, places)
def test_springs_and_turns_together_are_the_derivative_of_the_forces(collider, spacing, where):
    contact, positions = contact_at(FlaredProbe(collider, spacing), where)
    step = 1e-7
    forces, normals = forces_around(contact, positions, step)
    further, _ = forces_around(contact, positions, 2 * step)
    slope = (forces[0] - forces[1]).transpose(1, 2, 0) / (2 * step)  # (P, 3, 3) N/m
    wider = (further[0] - further[1]).transpose(1, 2, 0) / (4 * step)
    middle = np.abs(forces[0] + forces[1] - 2 * contact.force).max(axis=(0, 2)) / step
    smooth = np.abs(slope - wider).max(axis=(1, 2)) < 1e-3 * STIFF
    bent = np.abs(normals[0] - normals[1]).max(axis=(0, 2)) / (2 * step)
    # Of the curvature near the core a part is left out.
    smooth &= (middle < 1e-2 * STIFF) & (bent < 1.0 / collider.offset_box[3])
    expected = np.zeros_like(slope)
    active, directions, stiffness = contact.springs_after(np.zeros_like(positions))
    expected[active] -= np.einsum("k,ki,kj->kij", stiffness, directions, directions)
    turned, turn = contact.geometric_stiffness(positions, contact.normal_force)
    assert (contact.normal_force[turned] > 0.0).all()
    expected[turned] += turn
    np.testing.assert_allclose(expected[smooth], slope[smooth], atol=5e-3 * STIFF)
    # Forces with an energy have a symmetric tangent.
    np.testing.assert_allclose(expected, expected.transpose(0, 2, 1), atol=1e-9 * STIFF)
    np.testing.assert_allclose(slope[smooth], slope[smooth].transpose(0, 2, 1), atol=1e-3 * STIFF)


@EXAMPLES
@given(shapes, places, seeds)
def test_energy_and_forces_know_only_the_pose_and_the_positions(probe, where, seed):
    contact, positions = contact_at(probe, where)
    other, rng = contact_of(probe, len(positions)), np.random.default_rng(seed)
    for _ in range(4):
        pose = Pose(TURNED.position + 0.02 * rng.normal(size=3), TURNED.orientation)
        other.set_pose(pose, positions + 0.01 * rng.normal(size=3))
    other.update_gaps(positions + 0.01)
    other.set_pose(TURNED, positions)
    other.drop_planes(positions)
    assert other.energy == contact.energy
    np.testing.assert_array_equal(other.force, contact.force)
    assert other.drop_planes(positions) is False


def test_deep_points_are_pushed_back_through_where_they_came_in_until_they_are_released():
    # A wide box that came from its side, and before: the nearest way out is the front's.
    probe, start = FlaredProbe(RoundedBox(0.05, 0.03, 0.06, 0.006), FINE), np.zeros((1, 3))
    contact = contact_of(probe, 1)
    assert probe.deep == pytest.approx(0.5 * 0.015)
    contact.set_pose(Pose(position=[-0.034, 0.0, 0.01]), start)
    assert not contact.normal_force.any()
    contact.set_pose(Pose(position=[-0.016, 0.0, 0.01]), start)
    np.testing.assert_allclose(contact.normal, [[1.0, 0.0, 0.0]], atol=1e-9)
    assert contact.gap[0] == pytest.approx(-0.009, abs=2e-6)
    # The plane stays where it is as the point moves, and it is flat.
    moved = np.array([[0.004, 0.002, 0.001]])
    contact.update_gaps(moved)
    assert contact.gap[0] == pytest.approx(-0.005, abs=2e-6)
    assert len(contact.geometric_stiffness(moved, contact.normal_force)[0]) == 0
    contact.update_gaps(start)
    assert contact.drop_planes(start)
    assert contact.gap[0] == pytest.approx(-0.009)
    contact.set_pose(Pose(position=[-0.016, 0.0, 0.01]), start)
    # From the same place without a way there, it came from before the front.
    anew = contact_of(probe, 1)
    anew.set_pose(Pose(position=[-0.016, 0.0, 0.01]), start)
    np.testing.assert_allclose(anew.normal, [[0.0, 0.0, 1.0]], atol=1e-9)
    assert anew.gap[0] == pytest.approx(-0.01, abs=2e-6)
    assert anew.drop_planes(start)
    np.testing.assert_allclose(anew.normal, [[1.0, 0.0, 0.0]], atol=1e-9)


def test_after_a_leap_points_came_from_before_the_front():
    probe, start = FlaredProbe(RoundedBox(0.05, 0.03, 0.06, 0.006), FINE), np.zeros((1, 3))
    for way, normal in [(0.019, [1.0, 0.0, 0.0]), (0.021, [0.0, 0.0, 1.0])]:
        contact = contact_of(probe, 1)
        contact.set_pose(Pose(position=[-0.016 - way, 0.0, 0.01]), start)
        contact.set_pose(Pose(position=[-0.016, 0.0, 0.01]), start)
        np.testing.assert_allclose(contact.normal[0], normal, atol=1e-9)


@EXAMPLES
@given(shapes, places, seeds, st.floats(0.0, 10.0), st.floats(0.0, 1e5))
def test_a_length_along_a_change_minimises_the_energy(probe, where, seed, pull, curvature):
    contact, _ = contact_at(probe, where)
    rng = np.random.default_rng(seed)
    start, change = 2e-3 * rng.normal(size=(2, len(where), 3))

    def slope(length):
        return length * curvature * 1e-2 - pull - contact.work_along(start, change, length)

    assume(slope(0.0) < 0.0)
    length = contact.find_best_length(start, change, pull, curvature * 1e-2)
    if slope(1.0) <= 0.1 * abs(slope(0.0)):  # what is overshot does not matter
        assert length == 1.0
    else:
        # The least lies within half of the last interval, or anywhere where it is level.
        assert slope(max(length - 1 / 64, 0.0)) <= 0.0 <= slope(min(length + 1 / 64, 1.0))


def test_tissue_that_comes_back_to_a_probe_at_rest_is_pushed_again():
    plate = FlaredProbe(RoundedBox(0.04, 0.04, 0.03, 0.001), 0.005)
    contact, there = contact_of(plate, 1), np.array([[0.0, 0.0, -0.001]])
    away = there + np.array([0.0, 0.0, 2 * plate.reach])
    contact.set_pose(Pose(), away)
    assert not contact.drop_planes(away)
    contact.update_gaps(there)
    assert not contact.normal_force.any()  # it was too far to be looked at
    assert contact.drop_planes(there)
    assert contact.normal_force[0] > 0.0
    assert contact.energy > 0.0


def triangle_on(probe, corners, spacing=0.01):
    """A contact at the corners (3, 3) m of a triangle and in its middle, without a pose."""
    points = np.vstack([corners, corners.mean(axis=0)])
    corner = np.array([[-1, -1, -1]] * 3 + [[0, 1, 2]])
    weights = np.vstack([np.tile([1.0, 0.0, 0.0], (3, 1)), [1 / 3, 1 / 3, 1 / 3]])
    law = FlaredProbe(probe, spacing), np.full(4, STIFF), np.full(4, STRONG), 5e-3
    return PenaltyContact(*law, corner, weights), points


def test_a_triangle_with_its_corners_on_a_sphere_is_relieved_of_a_part_of_its_sagitta():
    radius, side = 0.03, 0.005
    turns = np.array([0.0, 2.0, 4.0]) * math.pi / 3
    away = side / math.sqrt(3)  # of the corners from the middle
    height = math.sqrt(radius**2 - away**2) - radius
    corners = np.stack([away * np.cos(turns), away * np.sin(turns), np.full(3, height)], axis=1)
    contact, points = triangle_on(Sphere(radius), corners)
    contact.set_pose(Pose(), points)
    np.testing.assert_allclose(contact.gap[:3], 0.0, atol=1e-15)
    assert contact.gap[3] == pytest.approx(0.4 * height)  # of 1 - 0.6


def test_a_flat_face_relieves_nothing_and_an_edge_no_more_than_springs_stiffen_in():
    flat = np.array([[0.0, 0.0, -1e-3], [5e-3, 0.0, -1e-3], [0.0, 5e-3, -1e-3]])
    plate = RoundedBox(0.1, 0.1, 0.03, 0.001)
    contact, points = triangle_on(plate, flat)
    contact.set_pose(Pose(), points)
    np.testing.assert_allclose(contact.gap, -1e-3, atol=1e-12)
    astride = flat + np.array([0.048, 0.0, 0.0])
    astride[1, 0] += 0.01  # far beside the edge at 50 mm; the middle is below it
    contact, points = triangle_on(plate, astride - [0.006, 0.0, 0.0])
    before = FlaredProbe(plate, 0.01).measure_distances(Pose(), points)[0]
    contact.set_pose(Pose(), points)
    relief = contact.gap - before
    np.testing.assert_array_equal(relief[:3], 0.0)
    assert before[3] < 0.0 < relief[3] <= 5e-3 / 2
