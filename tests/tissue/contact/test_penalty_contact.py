"""The energy of contact by springs: its slope, its bounds, and how far the probe sinks in."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.penalty_contact import PenaltyContact
from us_sim.tissue.contact.penetration import push_out

FINE, COARSE = 0.002, 0.02  # m, spacings that resolve the roundings below, and that do not
STIFF, STRONG = 2e3, 5.0  # N/m and N of every spring
BOX = RoundedBox(0.05, 0.03, 0.06, 0.004)
ROUNDED = RoundedBox(0.05, 0.03, 0.06, 0.012)
CURVED = Convex(radius=0.055, length=0.076, width=0.036, height=0.06, rounding=0.01)
ROUND = st.sampled_from([Sphere(0.03), Capsule(0.03, 0.04), ROUNDED, CURVED])
TURNED = Pose(np.array([0.1, -0.2, 0.3]), np.array([0.3, -0.2, 0.5, 0.8]))

lateral = st.floats(-0.05, 0.05)
points = st.lists(st.tuples(lateral, lateral, st.floats(-0.04, 0.01)), min_size=1, max_size=5)
moduli = st.floats(1.0, 1e5)


def contact_at(collider, where, spacing, pose=TURNED):
    """A contact aimed at points (K, 3) of the probe's frame, and these in the patient's."""
    positions = pose.apply(np.array(where, dtype=float))
    count = len(positions)
    contact = PenaltyContact(collider, spacing, np.full(count, STIFF), np.full(count, STRONG))
    contact.aim(pose, positions)
    return contact, positions


@settings(deadline=None, max_examples=60)
@given(ROUND, points, st.sampled_from([FINE, COARSE]), st.booleans())
def test_the_push_is_the_slope_of_the_energy(collider, where, spacing, augmented):
    contact, positions = contact_at(collider, where, spacing)
    if augmented:
        contact.augment(0.3)
    push, normal = contact.push.copy(), contact.normal.copy()
    # Deeper in a rounding than half of it the push is no gradient: see `push_out`.
    deep = contact.gap < -0.5 * collider.offset_box[3]
    step = 1e-7
    for axis in np.eye(3):
        for node in np.flatnonzero(~deep | contact.forward):
            moved, energy, normals = positions.copy(), [], []
            for sign in (1, -1):
                moved[node] = positions[node] + sign * step * axis
                contact.look(moved)
                energy.append(contact.energy)
                normals.append(contact.normal[node].copy())
            # At the edges of the surface the push changes its direction.
            if np.abs(np.subtract(*normals)).max() < 1e-3:
                slope = (energy[0] - energy[1]) / (2 * step)
                assert slope == pytest.approx(-push[node] * normal[node] @ axis, abs=1e-3)


@given(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.floats(0, 1), moduli, moduli)
def test_the_energy_is_convex_and_no_push_is_beyond_the_greatest(a, b, share, stiff, strong):
    contact = PenaltyContact(Sphere(0.03), COARSE, np.array([stiff]), np.array([strong]))

    def energy(height):
        contact.aim(Pose(), np.array([[0.0, 0.0, height]]))
        assert 0.0 <= contact.push[0] <= strong
        return contact.energy

    chord = (1 - share) * energy(a) + share * energy(b)
    assert energy((1 - share) * a + share * b) <= chord + 1e-12 * abs(chord)


@given(st.lists(st.floats(-0.02, 0.02), min_size=3, max_size=3), st.floats(0.0, 1.0))
def test_the_slope_at_a_gap_is_how_the_push_falls(gaps, most):
    contact, _ = contact_at(Sphere(0.03), [[0.0, 0.0, -0.001]] * 3, COARSE)
    contact.augment(most)
    gaps, step = np.array(gaps), 1e-9
    change = (contact.push_at(gaps - step) - contact.push_at(gaps + step)) / (2 * step)
    off_the_kinks = np.isclose(change, 0.0, atol=1e-3) | np.isclose(change, STIFF, rtol=1e-6)
    slope = contact.slope_at(gaps)
    np.testing.assert_allclose(slope[off_the_kinks], change[off_the_kinks], atol=1e-2)
    assert ((slope == 0.0) | (slope == STIFF)).all()


@settings(deadline=None)
@given(st.floats(100.0, 1e4), st.floats(1e3, 1e5), st.floats(1e-4, 0.02))
def test_multipliers_make_the_penetration_vanish(tissue, stiff, depth):
    # One node on a spring of the tissue's; the probe has come down by the depth.
    contact = PenaltyContact(Sphere(0.03), COARSE, np.array([stiff]), np.array([1e6]))
    contact.aim(Pose(position=[0.0, 0.0, depth]), np.zeros((1, 3)))
    lag, height = stiff / (stiff + tissue), 0.0
    for _ in range(1 + int(np.ceil(np.log(1e-7) / np.log(1 - lag)))):
        # The balance of tissue * height and stiff * (depth - height + shift).
        height = lag * (depth + height - height - contact.reach[0] + contact.gap[0])
        contact.look(np.array([[0.0, 0.0, height]]))
        assert contact.push[0] == pytest.approx(tissue * height, rel=1e-9)
        contact.augment(1.0)
    assert height == pytest.approx(depth, rel=1e-6)
    assert contact.reach[0] < 0  # the spring ends beyond the probe


def test_multipliers_end_at_the_fraction_that_is_asked_for():
    contact, _ = contact_at(Sphere(0.03), [[0.0, 0.0, -0.02]], COARSE)
    assert contact.push[0] == STRONG
    assert contact.augment(0.3) == pytest.approx(0.3 * STRONG / STIFF)
    assert contact.augment(0.3) == 0.0


def test_away_from_the_probe_nothing_is_pushed_and_multipliers_are_forgotten():
    contact, positions = contact_at(BOX, [[0.0, 0.0, -0.001], [0.0, 0.2, -0.001]], COARSE)
    np.testing.assert_allclose(contact.push, [2.0, 0.0], rtol=1e-12)
    contact.augment(1.0)
    contact.aim(Pose(position=[9.0, 0.0, 0.0]), positions)
    np.testing.assert_array_equal(contact.push, 0.0)
    assert contact.energy == 0.0
    contact.aim(TURNED, positions)
    np.testing.assert_allclose(contact.push, [2.0, 0.0], rtol=1e-12)
    contact.clear()
    np.testing.assert_array_equal(contact.push, 0.0)


@settings(deadline=None, max_examples=80)
@given(ROUND, lateral, lateral, st.floats(-0.04, 0.02))
def test_the_normal_turns_along_the_surface_as_its_curvature_says(collider, x, y, z):
    step = 1e-6
    where = TURNED.apply(np.array([[x, y, z]]))
    gap, normal = push_out(collider, TURNED, where, FINE)
    where -= gap[:, None] * normal
    contact, _ = contact_at(collider, TURNED.inverse().apply(where), FINE)
    facing = contact.normal[0] @ TURNED.rotation[:, 2] > 0.05
    assume(abs(contact.gap[0]) < 1e-9 and facing)  # it did not land beside the rounding
    expected = []
    for axis in np.eye(3):
        along = axis - (axis @ contact.normal[0]) * contact.normal[0]
        ahead = push_out(collider, TURNED, where + step * along, FINE)[1]
        back = push_out(collider, TURNED, where - step * along, FINE)[1]
        expected.append((ahead - back)[0] / (2 * step))
        # Where two parts of the surface meet, it is bent in two ways.
        assume(np.abs(ahead + back - 2 * contact.normal).max() < 1e-8)
    np.testing.assert_allclose(contact.curvature(where, np.array([0]))[0], expected, atol=1e-2)


def aside(where, skirt=0.0):
    where = np.array([where], dtype=float)
    gap, normal = push_out(BOX, Pose(), where, COARSE, np.array([skirt]), flanks=True)
    return gap[0], normal[0]


@pytest.mark.parametrize("depth", [0.006, 0.01, 0.02])
@pytest.mark.parametrize("entered", [1e-4, 1e-3])
def test_what_comes_in_from_the_side_is_pushed_aside_and_not_thrown_before_the_face(depth, entered):
    # Along a normal at 60 degrees to the axis, so far that it leaves the outline, 4 mm around.
    sine, cosine = np.sqrt(0.75), 0.5
    wide = 0.004 - entered  # from the core
    for core, direction in (
        ([0.021, 0.0], [1.0, 0.0]),
        ([0.0, -0.011], [0.0, -1.0]),
        ([0.021, 0.011], [0.6, 0.8]),
    ):
        x, y = np.add(core, wide * np.array(direction))
        gap, normal = aside([x, y, -depth])
        assert gap == pytest.approx(-entered / sine)
        np.testing.assert_allclose(normal, [*np.multiply(sine, direction), cosine], atol=1e-12)


def test_a_flank_ends_behind_the_probe_and_begins_behind_the_rounding():
    assert aside([0.0249, 0.0, -0.2])[0] == np.inf
    np.testing.assert_array_equal(aside([0.0249, 0.0, -0.0039])[1], [0, 0, 1])
    gap, normal = aside([0.0, 0.014, -0.0005])
    np.testing.assert_array_equal(normal, [0, 0, 1])
    assert gap == push_out(BOX, Pose(), np.array([[0.0, 0.014, -0.0005]]), COARSE)[0][0]


@settings(deadline=None, max_examples=200)
@given(st.floats(-0.024, 0.024), st.floats(-0.014, 0.014), st.floats(-0.03, 0.0))
def test_whatever_is_inside_is_pushed_out_the_shorter_way(x, y, z):
    gap, normal = aside([x, y, z])
    forward = push_out(BOX, Pose(), np.array([[x, y, z]]), COARSE)[0][0]
    assert gap >= forward - 1e-15
    landed = np.array([[x, y, z]]) - gap * normal
    assert (landed - [x, y, z])[0, 2] >= 0 or gap > 0
    if gap < 0:
        left, _ = push_out(BOX, Pose(), landed, COARSE, flanks=True)
        assert left[0] >= -1e-12


@settings(deadline=None, max_examples=200)
@given(st.floats(-0.01, 0.01), st.floats(0.0, 0.014), st.floats(-0.02, -0.005))
def test_where_front_and_flank_meet_the_gap_is_continuous(x, y, z):
    # Deep enough that the front is pushed from its flat part only.
    step = 1e-9
    here, there = aside([x, y, z])[0], aside([x, y + step, z + step])[0]
    assume(abs(y - 0.011) > 1e-6)  # there the rounding begins, square to the front
    assert abs(here - there) < 10 * step


@given(st.floats(0.0, 0.003), st.floats(0.0, 0.0019))
def test_what_the_front_holds_stays_with_it_past_the_rim_when_the_probe_sinks_in(beside, sunk):
    held = np.array([0.0, 0.015 + beside, -0.004 - sunk])
    gap, normal = aside(held, skirt=0.005)
    np.testing.assert_array_equal(normal, [0, 0, 1])
    assert gap == pytest.approx(-sunk, abs=1e-12)


def test_planes_follow_the_nodes_until_these_lie_on_the_surface():
    # 1 mm deep in a sphere that the nodes do not resolve, and then slid along its plane.
    def surface(x):
        return np.array([[x, 0.0, np.sqrt(0.03**2 - x**2) - 0.03]])

    below = np.array([[0.0, 0.0, -0.001]])
    contact, where = contact_at(Sphere(0.03), surface(0.01) + below, COARSE, Pose())
    assert contact.gap[0] == pytest.approx(-0.001)
    assert contact.follow(where) == pytest.approx(0.0, abs=1e-15)
    slid = surface(0.014) + below
    contact.look(slid)
    drop = surface(0.01)[0, 2] - surface(0.014)[0, 2]
    assert contact.gap[0] == pytest.approx(-0.001 - drop)
    assert contact.follow(slid) == pytest.approx(drop)
    assert contact.gap[0] == pytest.approx(-0.001)


def test_a_node_that_goes_to_and_fro_is_not_followed_without_end():
    contact, _ = contact_at(Sphere(0.03), [[0.0, 0.0, -0.002]], COARSE, Pose())
    changes = []
    for place in 60 * [[0.014, 0.0, -0.006], [0.01, 0.0, -0.006]]:
        contact.look(np.array([place]))
        changes.append(contact.follow(np.array([place])))
    assert changes[0] > 0.001
    assert not np.any(changes[-60:])
    contact.aim(Pose(position=[0.0, 0.0, 1e-6]), np.array([[0.01, 0.0, -0.006]]))
    assert contact.follow(np.array([[0.014, 0.0, -0.006]])) > 0.001
