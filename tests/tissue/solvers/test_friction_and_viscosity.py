"""`fem_nonlinear` against Coulomb's law, `fem` and the standard linear solid."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import at, block, block_mesh, require_reaction, settle

from us_sim.evaluation.independent_forces import neo_hookean_forces
from us_sim.geometry.collider import RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.penalty_contact import PenaltyFriction
from us_sim.tissue.contact.probe_gap import FlaredProbe
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.elasticity.neo_hookean import PronyBranch
from us_sim.tissue.solvers.fem import Fem, FemSettings
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear, FemNonlinearSettings
from us_sim.tissue.solvers.newton import Newton

PLATE = RoundedBox(0.5, 0.4, 0.1, 0.01)  # covers the whole block
LINEAR = RoundedBox(0.06, 0.04, 0.1, 0.004)


def rubbing(collider=PLATE, nodes=(9, 5, 5), contact="coulomb", **given):
    model = block(nodes, collider)
    return FemNonlinear(model, FemNonlinearSettings(contact=contact, **given))


def drags_and_pushes(model, pose, deformation):
    """(K, 3) and (K,) N, the forces at the touched nodes, from the tissue's alone."""
    displacement = deformation.nodes - model.mesh.nodes
    touched = deformation.contact_nodes
    forces = neo_hookean_forces(model.mesh, model.materials, displacement)[touched]
    _, normal = FlaredProbe(model.collider, model.contact_spacing).distance(
        pose, deformation.nodes[touched]
    )
    push = np.einsum("ij,ij->i", forces, normal)
    return forces - push[:, None] * normal, push


def press(solver, depth=0.01, frames=5):
    for z in np.linspace(0.0, depth, frames + 1)[1:]:
        solver.deform(at(z=z))
    return settle(solver, at(z=depth))


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.07, 0.3])
def test_a_dragged_block_sticks_and_then_slides_at_coulombs_force(friction):
    solver = rubbing(friction=friction)
    press(solver)
    ratios = []
    for x in np.arange(0.001, 0.025, 0.001):
        force = solver.deform(at(x=x, z=0.01)).force
        ratios.append(force[0] / force[2])
    # E / (2 (1 + nu)) A x / L = 3.45 kPa * 0.02 m2 * 1 mm / 0.1 m = 0.69 N at most as it sticks,
    # of 29.5 N; a bit less, as the block bends.
    assert 0.7 * 0.69 / 29.5 < ratios[0] < 1.02 * 0.69 / 29.5
    assert max(ratios) < 1.02 * friction
    np.testing.assert_allclose(ratios[-3:], friction, rtol=0.03)
    held = settle(solver, at(x=x, z=0.01))
    # At rest it may be held by less, as what was still on its way comes to rest.
    assert 0.9 * friction < held.force[0] / held.force[2] < 1.02 * friction


def test_sticking_nodes_go_where_the_probe_goes():
    solver = rubbing(LINEAR, (13, 9, 7), contact="sticking")
    start, there = at(z=0.01), at(x=0.002, y=0.001, z=0.01, orientation=(0.0, 0.0, 0.05, 1.0))
    press(solver)
    first, second = settle(solver, start), settle(solver, there)
    places = start.inverse().apply(first.nodes)
    under = np.intersect1d(first.contact_nodes, second.contact_nodes)
    under = under[(abs(places[under, 0]) < 0.02) & (abs(places[under, 1]) < 0.015)]
    assert len(under) > 2
    # But for what their springs are stretched.
    after = there.inverse().apply(second.nodes[under])
    np.testing.assert_allclose(after, places[under], atol=4e-4)
    assert second.force[0] < first.force[0] - 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("contact", "friction"), [("coulomb", 0.07), ("coulomb", 0.3), ("sticking", 0.3)]
)
def test_a_small_press_and_drag_is_that_of_linear_elasticity(contact, friction):
    model = block((13, 9, 7), PLATE)
    given = {"contact": contact, "friction": friction}
    solver, linear = (
        FemNonlinear(model, FemNonlinearSettings(**given)),
        Fem(model, FemSettings(**given)),
    )
    path = [at(z=z) for z in np.linspace(3e-5, 3e-4, 10)]
    path += [at(x=x, z=3e-4) for x in np.linspace(1e-5, 1e-4, 10)]
    for pose in path:
        found, expected = solver.deform(pose), linear.deform(pose)
    np.testing.assert_allclose(found.force[[0, 2]], expected.force[[0, 2]], rtol=0.03)
    displacement = expected.nodes - model.mesh.nodes
    error = np.linalg.norm(found.nodes - expected.nodes) / np.linalg.norm(displacement)
    assert error < 0.04  # the plate sinks in


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 1000),
    friction=st.floats(0.01, 1.5),
    collider=st.sampled_from([Sphere(0.04), PLATE]),
)
def test_a_held_probe_keeps_the_law_and_does_not_creep(seed, friction, collider):
    solver = rubbing(collider, friction=friction)
    random = np.random.default_rng(seed)
    position, turn = np.array([0.0, 0.0, 0.004]), np.zeros(3)
    for _ in range(8):
        pose = at(*position, np.append(turn, 1.0) / np.linalg.norm(np.append(turn, 1.0)))
        solver.deform(pose)
        position += [*random.normal(0.0, 0.003, 2), random.uniform(0.0, 0.003)]
        turn += random.normal(0.0, 0.02, 3)
    deformation = settle(solver, pose)
    drag, push = drags_and_pushes(solver.model, pose, deformation)
    assert push.min() > -1e-4 * push.max()
    if collider is PLATE:  # elsewhere a node's points are pushed in different directions
        assert (np.linalg.norm(drag, axis=1) <= friction * push + 2e-3 * push.max()).all()
    nanometre = np.array([1e-9, 0.0, 0.0])
    for k in range(20):  # a probe that has not moved at all would compute nothing
        later = solver.deform(Pose(pose.position + k % 2 * nanometre, pose.orientation))
    np.testing.assert_allclose(later.nodes, deformation.nodes, atol=5e-5)


@pytest.mark.slow
def test_the_wrench_is_what_holds_the_block():
    solver = rubbing(LINEAR, (13, 7, 6), friction=0.5, tolerance=1e-8)
    press(solver)
    pose = at(x=0.005, z=0.01, orientation=(0.0, 0.0, 0.1, 1.0))
    deformation = settle(solver, pose)
    require_reaction(solver.model, pose, deformation)
    assert deformation.force[0] < -0.5
    assert solver.contact_stiffness() is None


@pytest.mark.parametrize("friction", [0.1, 1.0, np.inf])
def test_no_step_raises_the_energy(friction):
    newton = Newton(block((9, 5, 5), LINEAR), friction)
    for i in range(5):
        newton.update_contact()
        newton.set_pose(at(x=0.003 * i, y=0.001 * i, z=0.004 + 0.003 * i))
        newton.set_friction_bound(newton.contact.normal_force)
        for _ in range(6):
            newton.update_relief()  # as a step begins
            before = newton.energy
            newton.step(20)
            assert newton.energy <= before * (1 + 1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), friction=st.floats(0.01, 2.0))
def test_forces_are_the_energys_slope_and_springs_are_theirs(seed, friction):
    random = np.random.default_rng(seed)
    count = 6
    stiffness, nodes = random.uniform(500, 2000, count), random.normal(0, 0.01, (count, 3))
    nodes[:, 2] = random.uniform(-1e-3, 1e-3, count)
    plate, strongest = FlaredProbe(PLATE, 0.01), np.full(count, 50.0)
    contact = PenaltyFriction(plate, stiffness, strongest, 0.01, friction)
    contact.set_pose(at(z=2e-3), nodes)
    contact.set_friction_bound(contact.normal_force)
    contact.set_pose(at(x=1e-3, y=-5e-4, z=2e-3, orientation=(0.05, 0.0, 0.1, 1.0)), nodes)
    change = random.normal(0, 1e-9, (count, 3))
    energy, force = contact.energy, contact.force
    index, directions, springs = contact.springs_after(np.zeros_like(change))
    predicted = force.copy()
    pulls = springs * np.einsum("ij,ij->i", directions, change[index])
    np.add.at(predicted, index, -pulls[:, None] * directions)
    after = contact.force_after(change)
    contact.update_gaps(nodes + change)
    np.testing.assert_allclose(contact.force, after, atol=1e-12)
    np.testing.assert_allclose(after, predicted, atol=1e-10)
    rise = -((force + after) / 2 * change).sum()
    assert contact.energy - energy == pytest.approx(rise, abs=1e-13)


def test_stiff_tissue_sticks_as_soft_one_does():
    soft = rubbing(friction=0.2)
    materials = uniform_material(block_mesh((9, 5, 5)), Material(1e6, 0.45, 1000.0))
    stiff = FemNonlinear(
        block((9, 5, 5), PLATE, materials=materials),
        FemNonlinearSettings(contact="coulomb", friction=0.2),
    )
    press(soft), press(stiff)
    pose = at(x=0.004, z=0.01)
    np.testing.assert_allclose(
        settle(stiff, pose).force, 100 * settle(soft, pose).force, rtol=0.01, atol=2.0
    )


DEPTH, SHARE, TIME, FRAME = 1e-4, 0.5, 0.4, 0.01


def column(viscosity=SHARE):
    """Without sideways strain, so that E A d / L = 0.2 N is the force of rest at the depth, but for
    what the probe sinks in.
    """
    nodes = (5, 4, 4)
    materials = uniform_material(block_mesh(nodes), Material(10e3, 0.0, 1000.0))
    return FemNonlinear(
        block(nodes, PLATE, materials=materials),
        FemNonlinearSettings(viscosity=viscosity, relaxation_time=TIME, frame_interval=FRAME),
    )


@pytest.fixture(scope="module")
def sunk():
    """How far the probe sinks into the springs of its contact, over how far the tissue gives way;
    as a spring in series does.
    """
    solver = column(viscosity=0.0)
    for _ in range(5):
        force = -solver.deform(at(z=DEPTH)).force[2]
    part = 0.2 / force - 1
    assert 0.0 < part < 0.06
    return part


def test_the_force_relaxes_as_that_of_a_standard_linear_solid(sunk):
    solver = column()
    forces = np.array([-solver.deform(at(z=DEPTH)).force[2] for _ in range(120)])
    # Pressed during the first frame, so half of it ago.
    time = FRAME * (np.arange(120) + 0.5)
    slower = TIME * (1 + SHARE * sunk / (1 + sunk))
    beyond = SHARE / (1 + sunk * (1 + SHARE)) * np.exp(-time / slower)
    np.testing.assert_allclose(forces[2:], (0.2 * (1 + beyond) / (1 + sunk))[2:], rtol=0.01)
    over = forces[2:80] - 0.2 / (1 + sunk)
    slope = np.polyfit(time[2:80], np.log(over), 1)[0]
    assert slope == pytest.approx(-1 / slower, rel=0.02)


def test_a_ramp_meets_the_force_of_a_standard_linear_solid(sunk):
    solver, speed = column(), DEPTH / 0.5
    time = FRAME * np.arange(1, 51)
    forces = [-solver.deform(at(z=speed * t)).force[2] for t in time]
    # Of the ramp d = v t: k v (t + g T (1 - exp(-t / T))), with a spring in series.
    slower = TIME * (1 + SHARE * sunk / (1 + sunk))
    late = SHARE * TIME / (1 + sunk) * (1 - np.exp(-time / slower))
    expected = 2000 * speed * (time + late) / (1 + sunk)
    np.testing.assert_allclose(forces[10:], expected[10:], rtol=0.02)


@pytest.mark.slow
def test_what_is_let_go_creeps_back_to_rest(sunk):
    solver = column()
    for _ in range(1500):
        pressed = solver.deform(at(z=DEPTH))
        if solver.deform(at(z=DEPTH)) is pressed:
            break
    assert pressed.force[2] == pytest.approx(-0.2 / (1 + sunk), rel=2e-3)
    depths, free = [], None
    while len(depths) < 1500:
        before, free = free, solver.deform(None)
        if free is before:
            break
        depths.append(np.abs(free.nodes - solver.model.mesh.nodes).max())
    assert not free.force.any()
    np.testing.assert_array_equal(free.nodes, solver.model.mesh.nodes)
    # k u + g k (u - v) = 0 and dv/dt = (u - v) / T make both fall with (1 + g) T.
    time = FRAME * (np.arange(60) + 0.5)
    expected = DEPTH / (1 + sunk) * SHARE / (1 + SHARE) * np.exp(-time / TIME / (1 + SHARE))
    np.testing.assert_allclose(depths[:60], expected, rtol=0.02)


def test_a_probe_that_is_near_does_not_end_the_creeping():
    model = block((9, 5, 5))
    solver = FemNonlinear(model, FemNonlinearSettings(viscosity=1.0, relaxation_time=0.2))
    for _ in range(60):
        solver.deform(at(z=0.015))
    away = [solver.deform(at(z=-0.02)) for _ in range(20)]
    dents = [(frame.nodes - model.mesh.nodes)[:, 2].max() for frame in away]
    assert dents[0] > 0.003
    assert (np.diff(dents) < 0).all()
    assert not any(len(frame.contact_nodes) for frame in away)


def test_no_step_raises_the_energy_of_viscous_tissue():
    branch = PronyBranch(1.0, relaxation_time=0.1, interval=0.02)
    newton = Newton(block((9, 5, 5)), branch=branch)
    for i in range(5):
        newton.relax()
        newton.set_pose(at(x=0.003 * i, z=0.004 + 0.003 * i))
        for _ in range(6):
            newton.update_relief()  # as a step begins
            before = newton.energy
            newton.step(20)
            assert newton.energy <= before * (1 + 1e-9)


@pytest.mark.slow
def test_a_state_that_is_taken_over_is_relaxed(sunk):
    first, second = column(), column()
    for _ in range(300):
        first.deform(at(z=DEPTH))
    second.take_over(first.state)
    for _ in range(3):
        force = second.deform(at(z=DEPTH)).force
    assert force[2] == pytest.approx(-0.2 / (1 + sunk), rel=0.02)
