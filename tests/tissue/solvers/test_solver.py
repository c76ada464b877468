"""Laws of every tissue solver, and of one that goes on from where another is."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from tissue_block import block, block_mesh

from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SOLVERS
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import make_uniform_materials
from us_sim.tissue.model import Intervention, TissueState
from us_sim.tissue.solvers.solver import create_solver

PRESSED = Pose(np.array([0.004, 0.0, 0.008]))
AWAY = Pose(np.array([0.0, 0.0, -0.05]))


@pytest.fixture(params=list(SOLVERS))
def solver(request):
    return create_solver(request.param, block((9, 5, 5)))


def settled(solver, pose, frames=400):
    for _ in range(frames):
        deformation = solver.deform(pose)
    return deformation


def test_a_fresh_solver_is_at_rest(solver):
    deformation = solver.deform(None)
    np.testing.assert_array_equal(deformation.nodes, solver.model.mesh.nodes)
    assert solver.deform(AWAY).residual == 0
    assert not solver.state.displacement.any()


def test_a_settled_solver_with_an_unmoved_probe_does_no_work(solver):
    deformation = settled(solver, PRESSED, 1000)
    assert solver.deform(PRESSED) is deformation
    same = Pose(np.array(PRESSED.position), np.array(PRESSED.orientation))
    assert solver.deform(same) is deformation
    assert solver.deform(AWAY) is not deformation


def test_the_tissue_pushes_the_probe_back_and_shapes_agree(solver):
    deformation = settled(solver, PRESSED, 60)
    assert deformation.nodes.shape == solver.model.mesh.nodes.shape
    assert deformation.force[2] < -0.1
    assert deformation.contact_nodes.dtype == np.int32
    assert np.isin(deformation.contact_nodes, solver.model.contact_nodes).all()
    assert 0 <= deformation.residual < 0.1


def test_the_same_poses_give_the_same_bytes(solver):
    twin = create_solver(solver.name, solver.model)
    for frame in range(12):
        pose = Pose(np.array([0.001 * frame, 0.0, 0.01 * np.sin(0.3 * frame)]))
        ours, theirs = solver.deform(pose), twin.deform(pose)
        assert ours.nodes.tobytes() == theirs.nodes.tobytes()
        assert ours.force.tobytes() + ours.torque.tobytes() == (
            theirs.force.tobytes() + theirs.torque.tobytes()
        )
        assert ours.residual == theirs.residual


def test_results_are_not_overwritten_by_the_next_frame(solver):
    first = solver.deform(PRESSED)
    kept = first.nodes.copy()
    solver.deform(AWAY)
    np.testing.assert_array_equal(first.nodes, kept)


def test_reset_is_a_fresh_start(solver):
    expected = [solver.deform(PRESSED).nodes.tobytes() for _ in range(3)]
    solver.reset()
    np.testing.assert_array_equal(solver.deform(None).nodes, solver.model.mesh.nodes)
    solver.reset()
    assert [solver.deform(PRESSED).nodes.tobytes() for _ in range(3)] == expected


def test_warming_up_moves_nothing(solver):
    solver.deform(PRESSED)
    before = solver.state.displacement.copy()
    solver.warm_up()
    np.testing.assert_array_equal(solver.state.displacement, before)


def test_held_nodes_stay(solver):
    deformation = settled(solver, PRESSED, 10)
    held = solver.model.fixed
    np.testing.assert_array_equal(deformation.nodes[held], solver.model.mesh.nodes[held])


def test_a_release_ends_at_rest(solver):
    for frame in range(30):
        solver.deform(Pose(np.array([0.0, 0.0, 0.0004 * frame])))
    assert abs(solver.state.displacement).max() > 0.01
    deformation = settled(solver, AWAY)
    np.testing.assert_array_equal(deformation.nodes, solver.model.mesh.nodes)
    assert deformation.residual == 0
    assert not deformation.force.any()
    assert len(deformation.contact_nodes) == 0
    assert solver.deform(AWAY) is deformation


@contextlib.contextmanager
def failing(solver, node, value):
    """Within it, each frame of the solver puts a node at ``value``."""
    advance = type(solver)._advance

    def fail(self, pose):
        deformation = advance(self, pose)
        deformation.nodes[node] = value
        return deformation

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(solver), "_advance", fail)
        yield


def test_the_last_good_state_is_kept_when_a_frame_fails(solver):
    good = solver.deform(PRESSED)
    before = solver.state.displacement.copy()
    for broken in (np.nan, np.inf, 1e6):
        with failing(solver, -1, broken):
            deformation = solver.deform(Pose(np.array([0.0, 0.0, 0.01])))
        assert deformation.interventions == Intervention.FRAME_FAILED | Intervention.KEPT_STATE
        assert deformation.action
        np.testing.assert_array_equal(deformation.nodes, good.nodes)
        np.testing.assert_allclose(solver.state.displacement, before, atol=1e-15)
    after = settled(solver, PRESSED, 60)
    assert after.residual < 0.1
    assert not after.interventions


def test_a_tissue_that_goes_on_failing_is_put_to_rest(solver):
    solver.deform(PRESSED)
    with failing(solver, 0, np.nan):
        done = [solver.deform(Pose([0.0, 0.0, 0.001 * k])).interventions for k in range(5)]
    assert all(Intervention.KEPT_STATE in each for each in done[:4])
    assert Intervention.PUT_TO_REST in done[4]
    assert not solver.state.displacement.any()
    assert settled(solver, PRESSED, 60).residual < 0.1


def test_a_deformed_tissue_that_is_taken_over_untouched_goes_back(solver):
    other = create_solver("fem_cg", solver.model)
    settled(other, PRESSED, 20)
    solver.take_over(other.state)
    np.testing.assert_allclose(solver.state.displacement, other.state.displacement, atol=1e-16)
    after = settled(solver, None)
    np.testing.assert_array_equal(after.nodes, solver.model.mesh.nodes)


def state(count=225, **changes):
    made = TissueState.at_rest(count)
    for name, value in changes.items():
        getattr(made, name)[0] = value
    return made


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (state(count=8), "8 nodes.* 225"),
        (state(displacement=np.nan), "not finite"),
        (state(velocity=np.inf), "not finite"),
    ],
)
def test_states_that_do_not_fit_are_refused(solver, wrong, words):
    with pytest.raises(SolverError, match=words):
        solver.take_over(wrong)


def test_a_state_that_moves_held_nodes_is_refused(solver):
    moved = state()
    moved.displacement[np.flatnonzero(solver.model.fixed)[0]] = 0.001
    with pytest.raises(SolverError, match="fixed nodes"):
        solver.take_over(moved)


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(SolverError, match=r"magic.*fem_nonlinear"):
        create_solver("magic", block((3, 3, 3)))
    with pytest.raises(SolverError, match=r"fem_cg: speed: .*iterations"):
        create_solver("fem_cg", block((3, 3, 3)), speed=3)


@pytest.mark.parametrize("name", [name for name in SOLVERS if SOLVERS.load(name).must_be_held])
def test_tissue_that_is_not_held_is_refused(name):
    with pytest.raises(SolverError, match="0 fixed nodes"):
        create_solver(name, block((3, 3, 3), held=()))


@pytest.mark.parametrize("ratio", [0.2, 0.45])  # without and with averaged pressures
@pytest.mark.parametrize("name", list(SOLVERS))
def test_tissue_that_is_all_held_does_not_move(name, ratio):
    materials = make_uniform_materials(block_mesh((3, 3, 3)), Material(10e3, ratio))
    model = replace(block((3, 3, 3), materials=materials), fixed=np.ones(27, dtype=bool))
    deformation = create_solver(name, model).deform(PRESSED)
    np.testing.assert_array_equal(deformation.nodes, model.mesh.nodes)
    assert deformation.residual == 0
    assert not deformation.force.any()
