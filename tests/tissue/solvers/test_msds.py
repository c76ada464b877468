"""The mass-spring tissue: what it conserves, where it comes to rest, and how it stays stable."""

import numpy as np
import pytest
from tissue_block import at, block

from us_sim.geometry.collider import Capsule, RoundedBox, Sphere
from us_sim.tissue.elasticity.stability import count_inverted
from us_sim.tissue.model import Intervention, TissueState
from us_sim.tissue.solvers.msds import Msds, MsdsSettings

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


def test_substeps_reach_the_same_rest_as_scaled_masses():
    settings = {"damping_factor": 2e-3}
    scaled = Msds(block((6, 4, 4)), MsdsSettings(**settings))
    divided = Msds(block((6, 4, 4)), MsdsSettings(stabilisation="substeps", **settings))
    for frame in range(300):
        pose = at(z=min(2e-4 * frame, 0.006))
        ours, theirs = scaled.deform(pose), divided.deform(pose)
    assert scaled.mass.sum() > divided.mass.sum() == pytest.approx(divided.model.lumped_mass.sum())
    np.testing.assert_allclose(ours.nodes, theirs.nodes, atol=2e-5)
    np.testing.assert_allclose(ours.force, theirs.force, atol=0.01)


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


def test_a_short_frame_in_which_little_moves_is_not_taken_for_rest():
    # Creeping back takes some times of the damping factor, here thousands of frames.
    solver = Msds(block((6, 4, 4)), MsdsSettings(time_step=1e-5, damping_factor=0.1))
    bent = TissueState.at_rest(len(solver.model.mesh.nodes))
    bent.displacement[~solver.model.fixed, 2] = 1e-3
    solver.take_over(bent)
    first = solver.deform(None)
    assert solver.deform(None) is not first
    assert 0 < abs(solver.state.velocity).max() * 20 * 1e-5 < 1e-5


def test_fitted_springs_that_keep_volume_tangle_less():
    tangled = {}
    for chosen in ({}, {"stiffness": "fitted", "volume": True}):
        solver = Msds(block((13, 7, 6), RoundedBox(0.05, 0.02, 0.1, 0.003)), MsdsSettings(**chosen))
        for frame in range(40):
            solver.deform(at(z=min(0.001 * frame, 0.02)))
        nodes = solver.model.mesh.nodes + solver.state.displacement
        tangled[bool(chosen)] = count_inverted(nodes, solver.model.mesh.tetrahedra)
    assert tangled[False] > 0 == tangled[True]
