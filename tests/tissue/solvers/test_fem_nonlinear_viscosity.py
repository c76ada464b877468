"""Viscous tissue of `fem_nonlinear` against the standard linear solid."""

import numpy as np
import pytest
from tissue_block import block, block_mesh

from us_sim.errors import SolverError
from us_sim.geometry.collider import RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.elasticity.neo_hookean import PronyBranch
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear, FemNonlinearSettings
from us_sim.tissue.solvers.newton import Newton

PLATE = RoundedBox(0.5, 0.4, 0.1, 0.01)  # covers the whole block
DEPTH, SHARE, TIME, FRAME = 1e-4, 0.5, 0.4, 0.01


def at(x=0.0, y=0.0, z=0.0):
    return Pose(np.array([x, y, z]))


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


def test_what_has_relaxed_is_as_without():
    given = {"contact": "coulomb", "friction": 0.3}
    model, pose = block((9, 5, 5), Sphere(0.04)), at(x=0.005, z=0.012)
    plain = FemNonlinear(model, FemNonlinearSettings(**given))
    viscous = FemNonlinear(
        model, FemNonlinearSettings(viscosity=0.5, relaxation_time=0.02, **given)
    )
    for solver in (plain, viscous):
        for _ in range(60):
            deformation = solver.deform(pose)
        assert deformation.residual <= 1e-5
        assert solver.deform(pose) is deformation
    # Friction remembers how the tissue came there.
    np.testing.assert_allclose(viscous._last.force, plain._last.force, atol=0.2)
    np.testing.assert_allclose(viscous._last.nodes, plain._last.nodes, atol=3e-4)


def test_no_step_raises_the_energy():
    branch = PronyBranch(1.0, relaxation_time=0.1, interval=0.02)
    newton = Newton(block((9, 5, 5)), branch=branch)
    for i in range(5):
        newton.relax()
        newton.set_pose(at(x=0.003 * i, z=0.004 + 0.003 * i))
        for _ in range(6):
            before = newton.energy
            newton.step(20)
            assert newton.energy <= before * (1 + 1e-9)


def test_a_state_that_is_taken_over_is_relaxed(sunk):
    first, second = column(), column()
    for _ in range(300):
        first.deform(at(z=DEPTH))
    second.take_over(first.state)
    for _ in range(3):
        force = second.deform(at(z=DEPTH)).force
    assert force[2] == pytest.approx(-0.2 / (1 + sunk), rel=0.02)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"viscosity": -0.1}, "viscosity: -0.1 is outside 0 to 10"),
        ({"relaxation_time": 0.0}, "relaxation_time: 0 s is outside 0.001 to 1000 s"),
        ({"frame_interval": 0.0}, "frame_interval: 0 s is outside 0.0001 to 10 s"),
    ],
)
def test_settings_out_of_range_are_refused(given, words):
    with pytest.raises(SolverError, match=f"fem_nonlinear.{words}"):
        FemNonlinearSettings(**given)
