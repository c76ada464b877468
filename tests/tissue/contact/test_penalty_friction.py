"""The energy of friction by springs: its slope, Coulomb's bound, and what slips between frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry.collider import RoundedBox
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.penalty_contact import PenaltyFriction
from us_sim.tissue.contact.probe_gap import FlaredProbe

COUNT, STIFF, STRONG = 6, 2e3, 20.0  # springs, N/m and N of each
PLATE = FlaredProbe(RoundedBox(0.1, 0.1, 0.03, 0.001), 0.01)
PRESSED = Pose([0.0, 0.0, 2e-3])
laws = st.sampled_from([0.1, 0.5, np.inf])
seeds = st.integers(0, 2**32 - 1)
EXAMPLES = settings(deadline=None, max_examples=60)


def plate_on(friction, count=COUNT):
    contact = PenaltyFriction(PLATE, np.full(count, STIFF), np.full(count, STRONG), 5e-3, friction)
    contact.set_pose(PRESSED, np.zeros((count, 3)))
    contact.set_friction_bound(contact.normal_force)
    return contact


def dragged(friction, seed):
    """A contact under a plate whose points were moved by about as far as they stick."""
    contact, rng = plate_on(friction), np.random.default_rng(seed)
    positions = rng.normal(size=(COUNT, 3)) * [1e-3, 1e-3, 3e-4]
    contact.update_gaps(positions)
    return contact, positions, rng


@EXAMPLES
@given(laws, seeds)
def test_the_force_is_the_slope_of_the_energy(friction, seed):
    contact, positions, rng = dragged(friction, seed)
    force, step = contact.force, 1e-8
    along = rng.normal(size=positions.shape)
    energy = []
    for sign in (1, -1):
        contact.update_gaps(positions + sign * step * along)
        energy.append(contact.energy)
    slope = (energy[0] - energy[1]) / (2 * step)
    assert slope == pytest.approx(-(force * along).sum(), abs=1e-4)


@EXAMPLES
@given(laws, seeds)
def test_springs_are_how_the_force_falls_with_a_change(friction, seed):
    contact, positions, rng = dragged(friction, seed)
    change, along = rng.normal(size=(2, COUNT, 3)) * 5e-4
    step = 1e-5
    ends = [contact.force_after(change + sign * step * along) for sign in (1, 0, -1)]
    kinked = np.abs(ends[0] + ends[2] - 2 * ends[1]).max(axis=1) > 1e-3 * STIFF * step * 5e-4
    expected = np.zeros((COUNT, 3))
    for point, direction, stiffness in zip(*contact.springs_after(change), strict=True):
        assert stiffness > 0.0
        assert np.linalg.norm(direction) == pytest.approx(1.0)
        expected[point] += stiffness * direction * (direction @ along[point])
    fall = (ends[2] - ends[0]) / (2 * step)
    np.testing.assert_allclose(expected[~kinked], fall[~kinked], atol=1e-3 * STIFF * 5e-4)
    work = (ends[1] * along).sum()
    assert contact.work_along(change, along, 0.0) == pytest.approx(work)
    assert contact.work_along(change - 2.0 * along, along, 2.0) == pytest.approx(work)
    contact.update_gaps(positions + change)
    np.testing.assert_allclose(contact.force, ends[1], atol=1e-9)  # the plate is flat


@EXAMPLES
@given(st.floats(0.01, 2.0), st.floats(0.0, 2 * np.pi), st.floats(0.0, 0.01))
def test_what_is_dragged_is_held_by_no_more_than_coulomb_allows(friction, angle, way):
    contact, direction = plate_on(friction, 1), np.array([np.cos(angle), np.sin(angle), 0.0])
    push = contact.normal_force[0]
    contact.update_gaps(way * direction[None])
    expected = min(STIFF * way, friction * push, STRONG)
    np.testing.assert_allclose(contact.force[0], [0.0, 0.0, push] - expected * direction, atol=1e-9)


def test_a_probe_at_rest_lets_nothing_creep():
    contact = plate_on(0.5)
    positions = np.full((COUNT, 3), [2e-3, 0.0, 0.0])
    contact.update_gaps(positions)
    force = contact.force
    assert contact.update_friction() == 0.0
    for _ in range(3):
        contact.update_gaps(positions)
        assert contact.update_friction() == pytest.approx(0.0, abs=1e-15)
        np.testing.assert_allclose(contact.force, force, atol=1e-12)


def test_points_that_slipped_turn_back_from_where_they_are():
    contact, stick = plate_on(0.5, 1), 0.5 * plate_on(0.5, 1).normal_force[0] / STIFF
    contact.update_gaps(np.array([[3 * stick, 0.0, 0.0]]))
    contact.update_friction()
    # Their springs hold Coulomb's bound still; half way back to their ends they hold half of it.
    contact.update_gaps(np.array([[2.5 * stick, 0.0, 0.0]]))
    assert contact.force[0, 0] == pytest.approx(-0.5 * stick * STIFF)
    contact.update_gaps(np.array([[stick, 0.0, 0.0]]))
    assert contact.force[0, 0] == pytest.approx(stick * STIFF)


def test_the_places_where_points_hang_go_with_the_probe():
    contact = plate_on(np.inf, 1)
    contact.set_pose(Pose([0.0, 1e-3, 2e-3]), np.zeros((1, 3)))
    contact.set_friction_bound(contact.normal_force)
    assert contact.force[0, 1] == pytest.approx(1e-3 * STIFF)
    # It is let go where the probe does not push it, and hangs anew where it is touched again.
    contact.set_pose(Pose([0.0, 1e-3, -1e-3]), np.zeros((1, 3)))
    contact.set_friction_bound(contact.normal_force)
    assert not contact.force.any()
    contact.set_pose(Pose([0.0, 2e-3, 2e-3]), np.zeros((1, 3)))
    contact.set_friction_bound(contact.normal_force)
    np.testing.assert_allclose(contact.force[0, :2], 0.0)


def test_without_a_probe_nothing_hangs():
    contact = plate_on(np.inf)
    contact.update_gaps(np.full((COUNT, 3), 1e-4))
    assert contact.energy > 0.0
    contact.clear()
    assert contact.energy == 0.0
    assert not contact.force.any()
