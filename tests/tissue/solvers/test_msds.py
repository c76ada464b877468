"""The mass-spring tissue: what it conserves, where it comes to rest, and how it stays stable."""

import numpy as np
import pytest
from tissue_block import at, block

from us_sim.geometry.collider import Capsule, RoundedBox, Sphere
from us_sim.tissue.elasticity.stability import count_inverted
from us_sim.tissue.model import Intervention, TissueState
from us_sim.tissue.solvers.msds import Msds

FRAME = 20 * 0.01  # s


def momentum(solver):
    """Linear and angular, about the patient's origin."""
    impulse = solver.mass[:, None] * solver.state.velocity
    positions = solver.model.mesh.nodes + solver.state.displacement
    return impulse.sum(axis=0), np.cross(positions, impulse).sum(axis=0)


def test_a_free_body_keeps_its_momentum():
    model = block((6, 4, 4), held=())
    solver = Msds(model)
    thrown = TissueState.at_rest(len(model.mesh.nodes))
    thrown.velocity[:] = np.random.default_rng(0).normal(0.01, 0.02, thrown.velocity.shape)
    solver.take_over(thrown)
    linear, angular = momentum(solver)
    for _ in range(20):
        solver.deform(None)
    after = momentum(solver)
    scale = (solver.mass[:, None] * abs(thrown.velocity)).sum()
    np.testing.assert_allclose(after[0], linear, atol=1e-13 * scale)
    np.testing.assert_allclose(after[1], angular, atol=1e-13 * scale)
    assert solver.state.velocity.std() < thrown.velocity.std()  # springs damp what is relative


def test_what_a_free_body_gains_the_probe_has_lost():
    model = block((6, 4, 4), held=())
    solver = Msds(model)
    slanted = (0.05, 0.1, 0.0, 1.0)
    for frame in range(6):
        pose = at(x=0.03, z=0.002 * frame, orientation=slanted)
        solver.deform(pose)
        # Once more with the probe still, so that its frame is the one that the wrench is given in.
        before, spin = momentum(solver)
        deformation = solver.deform(pose)
        after, spun = momentum(solver)
        force = pose.rotation @ deformation.force
        torque = pose.rotation @ deformation.torque + np.cross(pose.position, force)
        np.testing.assert_allclose(after - before, -force * FRAME, atol=1e-12)
        # Setting nodes onto the probe moves them without a push: angular momentum feels that.
        slack = 0.05 * abs(torque).max() * FRAME
        np.testing.assert_allclose(spun - spin, -torque * FRAME, atol=slack)
    assert momentum(solver)[0][2] > 0


def test_a_violent_start_calms_down_at_the_scaled_masses():
    solver = Msds(block((9, 5, 5)))
    shaken = TissueState.at_rest(len(solver.model.mesh.nodes))
    shaken.velocity[:] = np.random.default_rng(1).normal(0, 0.2, shaken.velocity.shape)
    solver.take_over(shaken)
    energies = []
    for _ in range(60):
        deformation = solver.deform(None)
        energies.append((solver.mass[:, None] * solver.state.velocity**2).sum())
    assert np.isfinite(deformation.nodes).all()
    assert energies[-1] < 1e-3 * energies[0]


@pytest.mark.parametrize(
    "collider", [Sphere(0.03), Capsule(0.01, 0.04), RoundedBox(0.05, 0.015, 0.1, 0.003)]
)
def test_rough_handling_is_survived_and_what_it_broke_is_mended(collider):
    model = block((13, 7, 6), collider)
    solver = Msds(model)
    for depth in [0.03, 0.002, 0.025, None, 0.06, 0.3, 0.15]:
        pose = None if depth is None else at(x=0.02 * (depth == 0.025), z=depth)
        for _ in range(4):
            deformation = solver.deform(pose)
            assert np.isfinite(deformation.nodes).all()
            assert np.isfinite(deformation.force).all()
    assert deformation.inverted == count_inverted(deformation.nodes, model.mesh.tetrahedra) > 0
    released = [solver.deform(None) for _ in range(200)]
    assert any(Intervention.PUT_TO_REST in each.interventions for each in released)
    for each in released:
        assert each.inverted == count_inverted(each.nodes, model.mesh.tetrahedra)
    np.testing.assert_array_equal(solver.deform(None).nodes, model.mesh.nodes)


def test_a_probe_that_appears_inside_comes_from_above():
    solver = Msds(block((9, 5, 5), RoundedBox(0.06, 0.04, 0.1, 0.003)))
    deformation = solver.deform(at(z=0.012))
    assert count_inverted(deformation.nodes, solver.model.mesh.tetrahedra) == 0
    assert len(deformation.contact_nodes) > 0
