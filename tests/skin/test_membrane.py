"""The skin membrane and its springs against known equilibria, laws of motion, and contact."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from us_sim.geometry.collider import Capsule, RoundedBox, Sphere
from us_sim.geometry.collider_distance import measure_distances
from us_sim.geometry.pose import Pose
from us_sim.geometry.triangles import TriangleParts, choose_part_size
from us_sim.skin.membrane import SHORTEST, SkinMembrane, spring_forces
from us_sim.skin.settings import MembraneSettings
from us_sim.skin.surface import TriangleSurface, bent_surface, plane_surface

COLLIDERS = [Sphere(0.03), Capsule(0.01, 0.04), RoundedBox(0.05, 0.02, 0.06, 0.006)]


def settled(membrane, pose, frames=200):
    """The skin after the membrane has come to rest with the probe at ``pose``."""
    previous = membrane.deform(pose)
    for _ in range(frames):
        skin = membrane.deform(pose)
        if skin is previous:
            return skin
        previous = skin
    raise AssertionError("the membrane does not settle")


def test_anchored_particles_lie_where_their_energy_is_least_outside_the_collider():
    """Without springs, against another minimiser (SciPy's SLSQP): no particle may be inside, nor
    the middle of a triangle's part."""
    sheet, collider = plane_surface((0.03, 0.03), 0.005), Sphere(0.03)
    skin = SkinMembrane(sheet, collider, MembraneSettings(stiffness=0.0))
    pose = Pose([0.001, -0.0005, 0.004])
    found = settled(skin, pose).vertices
    rest, parts = sheet.vertices, parts_of(sheet, collider)
    middles = np.zeros((len(parts.weights), len(rest)))
    np.put_along_axis(middles, sheet.triangles[parts.triangle], parts.weights, axis=1)
    outside = np.concatenate([np.eye(len(rest)), middles])
    centre = np.array([0.001, -0.0005, 0.004 - 0.03])

    # In mm, and of moves, so that all numbers are of the order of one.
    def away(x):
        return 1e3 * outside @ (rest - centre) + outside @ x.reshape(-1, 3)

    def slopes(x):
        return (outside[:, :, None] * away(x)[:, None, :] / 15.0).reshape(len(outside), -1)

    least = minimize(
        lambda x: 0.5 * (x**2).sum(),
        1e3 * (pressed(rest, centre, 0.031) - rest).ravel(),
        jac=lambda x: x,
        constraints={
            "type": "ineq",
            "fun": lambda x: ((away(x) ** 2).sum(axis=1) - 900.0) / 30.0,
            "jac": slopes,
        },
        method="SLSQP",
        options={"ftol": 1e-9, "maxiter": 300},
    )
    assert least.success
    moved = 1e-3 * least.x.reshape(-1, 3)
    assert np.abs(moved).max() > 3e-3
    # Pushed one after the other, they are not exactly there.
    np.testing.assert_allclose(found, rest + moved, atol=0.06 * 5e-3)


def parts_of(sheet, collider):
    """Parts of triangles that are all alike."""
    corners = sheet.vertices[sheet.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    size = choose_part_size(collider.offset_box[3], float(np.median(sides)))
    return TriangleParts(sides.max(axis=1), size)


def pressed(points, centre, radius):
    """Points moved out of a sphere."""
    away = points - centre
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    return np.where(distance < radius, centre + radius * away / distance, points)


def places_between(sheet, vertices, parts_of_a_side=6):
    """Places all over the triangles, at their corners too."""
    row, column = np.indices((parts_of_a_side + 1,) * 2).reshape(2, -1)
    row, column = (each[row + column <= parts_of_a_side] for each in (row, column))
    weights = np.column_stack([row, column, parts_of_a_side - row - column]) / parts_of_a_side
    return np.einsum("wk,tkd->twd", weights, vertices[sheet.triangles]).reshape(-1, 3)


@pytest.mark.parametrize("tilt", [0.0, 20.0, 40.0])
def test_no_edge_of_the_probe_comes_through_between_the_particles(tilt):
    sheet = plane_surface((0.16, 0.16), 0.004)
    collider = RoundedBox(0.046, 0.014, 0.04, 0.004)
    skin = SkinMembrane(sheet, collider)
    turn = Rotation.from_euler("xyz", [0.5 * tilt, tilt, 30.0], degrees=True).as_quat()
    for depth in np.linspace(0.0, 0.012, 25):
        pose = Pose([0.0, 0.0, depth], turn)
        found = skin.deform(pose)
        gap, _ = measure_distances(collider, pose, places_between(sheet, found.vertices))
        assert gap.min() > -0.4e-3
    assert settled(skin, pose).residual < 1e-3


def test_a_released_particle_is_a_damped_oscillator():
    """Symplectic Euler with the damper at the step's end, written out as its own recurrence."""
    triangle = TriangleSurface(
        np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 2, 1]])
    )
    skin = SkinMembrane(
        triangle,
        Sphere(0.03),
        MembraneSettings(
            stiffness=0.0, anchor_stiffness=4.0, damping=1.5, density=5.0, time_step=1e-3, steps=1
        ),
    )
    assert skin.step_limit > 1e-3
    np.testing.assert_allclose(skin.mass, 5.0 * 0.005 / 3)
    skin.deform(Pose([0, 0, 0.004]))
    displacement, velocity = 0.004, 0.0
    omega = np.sqrt(4.0 / skin.mass[0])
    for _ in range(300):
        velocity -= 1e-3 * omega**2 * displacement
        velocity /= 1 + 1e-3 * 2 * 1.5 * omega
        displacement += 1e-3 * velocity
        found = skin.deform(None)
        assert found.vertices[0, 2] == pytest.approx(displacement, abs=1e-12)
    assert 0.0 < displacement < 0.002
    assert found.action == ""


def test_edge_springs_conserve_momentum():
    """All that changes the sum of momenta is the anchors and their dampers."""
    sheet = bent_surface((0.1, 0.06), 0.01, flat_width=0.04, radius=0.05)
    skin = SkinMembrane(
        sheet, Sphere(0.03), MembraneSettings(stiffness=400.0, anchor_stiffness=1.0, steps=1)
    )
    for k in range(5):
        skin.deform(Pose([0, 0, 0.002 * k]))
    before = skin.deform(None)
    momentum = skin.mass @ skin.velocity
    skin_after = skin.deform(None)
    decay = 2 * np.sqrt(1.0 / skin.mass)
    anchors = 1.0 * (sheet.vertices - before.vertices)
    undamped = (skin.mass * (1 + 0.01 * decay)) @ skin.velocity
    np.testing.assert_allclose(undamped, momentum + 0.01 * anchors.sum(axis=0), atol=1e-12)
    assert np.abs(momentum).max() > 1e-6
    assert np.abs(skin_after.vertices - before.vertices).max() > 1e-4


def stored(length, natural):
    """J over N/m, of springs; below half of their natural length their force falls to zero."""
    shortest = SHORTEST * natural
    bent = 0.5 * (natural - shortest) ** 2 + 0.5 * (1 / SHORTEST - 1) * (shortest**2 - length**2)
    return np.where(length < shortest, bent, 0.5 * (length - natural) ** 2)


def energy(skin, vertices):
    """J, of the motion, the anchors and the springs, less that of the springs at rest."""
    settings, rest = skin.settings, skin.surface.vertices
    first, second = skin.surface.edges.T
    sides, at_rest = vertices[second] - vertices[first], rest[second] - rest[first]
    lengths, natural = np.linalg.norm(sides, axis=1), np.linalg.norm(at_rest, axis=1)
    tension = settings.prestrain * (at_rest * (sides - at_rest)).sum(axis=1)
    slack = (1 - settings.prestrain) * natural
    springs = (stored(lengths, slack) - stored(natural, slack) - tension).sum()
    anchors = settings.anchor_stiffness * ((vertices - rest) ** 2).sum()
    motion = (skin.mass[:, None] * skin.velocity**2).sum()
    return 0.5 * (motion + anchors) + settings.stiffness * springs


def test_energy_decays_and_the_skin_returns_to_rest():
    sheet = plane_surface((0.1, 0.1), 0.005)
    skin = SkinMembrane(sheet, Sphere(0.03))
    energies = [energy(skin, settled(skin, Pose([0, 0, 0.01])).vertices)]
    while energies[-1] > 0.0 and len(energies) < 100:
        rest = skin.deform(None)
        energies.append(energy(skin, rest.vertices))
    assert energies[0] > 1e-4
    assert (np.diff(energies) < 0).all()
    np.testing.assert_array_equal(rest.vertices, sheet.vertices)
    assert rest.residual == 0.0
    assert rest.action == ""
    assert len(energies) < 30


@pytest.mark.parametrize("collider", COLLIDERS, ids=lambda c: type(c).__name__)
def test_nothing_is_inside_the_probe_as_it_presses_and_slides(collider):
    sheet = bent_surface((0.16, 0.1), 0.005, flat_width=0.08, radius=0.06)
    skin = SkinMembrane(sheet, collider)
    for k in range(40):
        pose = Pose([1e-3 * k - 0.02, 5e-4 * k, min(5e-4 * k, 0.01)], [0.02 * k / 40, 0.1, 0, 1])
        found = skin.deform(pose)
        distance, _ = measure_distances(collider, pose, found.vertices)
        assert distance.min() >= -1e-9  # rounding
        assert np.isfinite(found.vertices).all()
        np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-12)
    assert found.residual < 0.5
    at_rest = settled(skin, pose)
    assert at_rest.residual < 1e-3
    distance, _ = measure_distances(collider, pose, at_rest.vertices)
    assert distance.min() >= -1e-9
    distance, _ = measure_distances(collider, pose, places_between(sheet, at_rest.vertices))
    assert distance.min() > -1e-4
    assert (np.abs(distance) < 1e-4).sum() > 100


def test_a_probe_that_appears_deep_in_the_skin_pushes_it_all_forwards():
    """Deeper than the capsule's axis, where the nearest surface is the one behind."""
    sheet = plane_surface((0.12, 0.12), 0.004)
    gradual, sudden = (SkinMembrane(sheet, Capsule(0.008, 0.03)) for _ in range(2))
    for depth in np.linspace(0, 0.012, 40):
        gradual.deform(Pose([0, 0, depth]))
    pose = Pose([0, 0, 0.012])
    first = sudden.deform(pose)
    assert first.vertices[:, 2].min() > -2e-3
    np.testing.assert_allclose(
        settled(sudden, pose).vertices, settled(gradual, pose).vertices, atol=2e-4
    )


def test_a_far_jump_is_taken_in_more_steps_and_said():
    sheet = plane_surface((0.12, 0.12), 0.004)
    skin = SkinMembrane(sheet, Capsule(0.004, 0.03), MembraneSettings(steps=5))
    skin.deform(Pose([-0.03, 0, 0.002]))
    found = skin.deform(Pose([-0.005, 0, 0.002]))
    assert "25 steps" in found.action


def test_prestrain_is_what_smooths_it():
    """Unstretched springs, as the paper's, leave what is beside the contact where it was."""
    sheet = plane_surface((0.1, 0.1), 0.0025)
    pose = Pose([0, 0, 0.0005])
    moved = [
        np.abs(settled(SkinMembrane(sheet, Sphere(0.01), each), pose).vertices[:, 2])
        for each in (MembraneSettings(prestrain=0.0), MembraneSettings(prestrain=0.2))
    ]
    # Farther from the contact's edge, at 3.2 mm, than a triangle is long.
    aside = np.hypot(*sheet.vertices[:, :2].T)
    beside = (aside > 0.007) & (aside < 0.0095)
    assert moved[1][beside].max() > 5 * moved[0][beside].max()


def test_masses_are_raised_to_what_the_step_needs():
    sheet = plane_surface((0.05, 0.05), 0.005)
    heavy = SkinMembrane(sheet, Sphere(0.03), MembraneSettings(density=2.0, time_step=1e-4))
    light = SkinMembrane(sheet, Sphere(0.03), MembraneSettings(density=2.0, time_step=0.01))
    # The stiffest row is a vertex with 8 springs, in the sheet's own lumped masses.
    valence = np.bincount(sheet.edges.ravel())
    limit = np.sqrt((4 * 2.0 * sheet.vertex_areas / (2 * 40.0 * valence + 4.0)).min())
    assert heavy.step_limit == pytest.approx(limit)
    assert light.step_limit == pytest.approx(limit)
    np.testing.assert_allclose(heavy.mass, 2.0 * sheet.vertex_areas)
    assert heavy.deform(Pose([0, 0, 0.002])).action == ""
    assert (light.mass > heavy.mass).all()
    found = light.deform(Pose([0, 0, 0.002]))
    assert f"{limit:.2g} s" in found.action


@settings(max_examples=15, deadline=None)
@given(
    stiffness=st.floats(0.0, 1e5),
    anchor=st.floats(1e-3, 1e4),
    damping=st.floats(1.0, 10.0),
    density=st.floats(1e-3, 1e3),
    prestrain=st.floats(0.0, 0.9),
    time_step=st.floats(1e-5, 1.0),
    seed=st.integers(0, 1000),
)
def test_no_settings_make_it_diverge(
    stiffness, anchor, damping, density, prestrain, time_step, seed
):
    rng = np.random.default_rng(seed)
    sheet = plane_surface((0.08, 0.08), 0.01)
    skin = SkinMembrane(
        sheet,
        Sphere(0.02),
        MembraneSettings(
            stiffness=stiffness,
            anchor_stiffness=anchor,
            damping=damping,
            density=density,
            prestrain=prestrain,
            time_step=time_step,
        ),
    )
    for _ in range(20):
        found = skin.deform(Pose(rng.uniform(-0.02, 0.02, 3), rng.normal(size=4)))
    pressed_energy = energy(skin, found.vertices)
    for _ in range(50):
        found = skin.deform(None)
        assert not found.has_failed
    # Euler conserves an energy of its own, which differs from this one where damping is slight;
    # 500 steps beyond the limit would raise it by many powers of ten.
    assert energy(skin, found.vertices) <= 3.0 * pressed_energy


def test_an_unmoved_probe_on_settled_skin_costs_nothing():
    skin = SkinMembrane(plane_surface((0.1, 0.1), 0.01), Sphere(0.03))
    pose = Pose([0, 0, 0.005])
    found = settled(skin, pose)
    assert skin.deform(Pose(pose.position, pose.orientation)) is found
    assert skin.deform(Pose([0, 0, 0.0051])) is not found


def test_forces_that_overflow_leave_the_latest_shape_and_say_so():
    skin = SkinMembrane(
        plane_surface((0.1, 0.1), 0.01), Sphere(0.03), MembraneSettings(time_step=1e-9)
    )
    object.__setattr__(skin.settings, "stiffness", 1e308)  # beyond any that settings allow
    before = skin.deform(None).vertices
    found = skin.deform(Pose([0, 0, 0.01]))
    assert found.has_failed
    assert found.action
    np.testing.assert_array_equal(found.vertices, before)
    assert not skin.velocity.any()


STIFFNESS, LENGTH = 40.0, 0.01  # N/m, m
EDGE = np.array([[0, 1]], np.int32)
REST = np.array([[0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0]])


def pull(length, direction=(1.0, 0.0, 0.0), prestrain=0.0):
    """(2, 3) N: the spring's force on its two ends, which are ``length`` apart."""
    ends = np.array([np.zeros(3), length * np.array(direction)])
    force = np.empty((2, 3))
    natural = np.array([(1 - prestrain) * LENGTH])
    spring_forces(force, ends, REST, EDGE, natural, prestrain * REST[1:], STIFFNESS, 0.0)
    return force


@pytest.mark.parametrize(
    ("length", "newtons"),
    [
        (0.015, 0.2),
        (0.01, 0.0),
        (0.0075, -0.1),
        (0.005, -0.2),  # half of its natural length, where it pushes most
        (0.0025, -0.1),
        (0.001, -0.04),
        (1e-9, -4e-8),
        (0.0, 0.0),
    ],
)
def test_a_spring_pulls_by_hooke_and_lets_go_below_half_of_its_length(length, newtons):
    force = pull(length)
    np.testing.assert_allclose(force[0], [newtons, 0.0, 0.0], rtol=1e-12, atol=1e-18)
    np.testing.assert_array_equal(force[1], -force[0])


@pytest.mark.parametrize("length", [0.001, 0.0049, 0.0051, 0.02])
def test_the_force_is_the_slope_of_the_energy(length):
    step = 1e-7
    slope = STIFFNESS * (stored(length + step, LENGTH) - stored(length - step, LENGTH)) / (2 * step)
    assert pull(length)[0, 0] == pytest.approx(slope, rel=1e-5)
