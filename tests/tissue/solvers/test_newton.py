"""Newton's method on the energy of tissue and contact: every step lowers it, from anywhere."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block, block_mesh

from us_sim.geometry.collider import RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.solvers.newton import Newton

NODES = (6, 5, 4)
COUNT = len(block_mesh(NODES).nodes)


def layered():
    """Soft and stiff tetrahedra side by side, nearly incompressible."""
    mesh = block_mesh(NODES)
    stiff = np.random.default_rng(0).uniform(size=len(mesh.tetrahedra)) < 0.3
    return TissueMaterials(
        np.where(stiff, 300e3, 3e3), np.where(stiff, 0.45, 0.49), np.full(len(stiff), 1e3)
    )


MODELS = {
    "sphere": block(NODES, Sphere(0.1)),  # pushes along its normals
    "box": block(NODES, RoundedBox(0.08, 0.05, 0.1, 0.004)),  # with flanks that lean
    "layered": block(NODES, Sphere(0.1), materials=layered()),
}
EVERY = pytest.mark.parametrize("name", MODELS)


@functools.cache
def newton_of(name):
    return Newton(MODELS[name])


def pressed(name, pose, size=0.0, seed=0):
    """At a pose, every free node displaced by about ``size`` (m)."""
    newton = newton_of(name)
    newton.reset()
    displacement = np.random.default_rng(seed).normal(size=(3, COUNT)) * size
    displacement[:, MODELS[name].fixed] = 0.0
    newton.set_displacement(displacement)
    newton.set_pose(pose)
    return newton


def at(x=0.0, y=0.0, z=0.0, tilt=0.0):
    return Pose(np.array([x, y, z]), np.array([tilt, 0.0, 0.0, 1.0]))


poses = st.builds(
    at, st.floats(-0.1, 0.1), st.floats(-0.05, 0.05), st.floats(-0.01, 0.05), st.floats(-0.3, 0.3)
)


@EVERY
@pytest.mark.parametrize("size", [1e-4, 1e-2])
def test_unbalanced_forces_are_the_slope_of_the_energy(name, size):
    newton = pressed(name, at(z=0.01), size)
    slope, start = newton.residual.copy(), newton.displacement
    assert newton.contact_norm > 0.0
    assert np.linalg.norm(slope) == pytest.approx(newton.residual_norm)
    change = np.random.default_rng(1).normal(size=(3, COUNT))
    change[:, MODELS[name].fixed] = 0.0
    step, energy = 1e-8, []
    for sign in (1, -1):
        newton.set_displacement(start + sign * step * change)
        energy.append(newton.energy)
    expected = (energy[0] - energy[1]) / (2 * step)
    scale = np.linalg.norm(slope) * np.linalg.norm(change)
    assert np.vdot(slope, change) == pytest.approx(expected, abs=1e-5 * scale)


@pytest.mark.slow
@EVERY
def test_every_step_lowers_the_energy_from_any_start_also_inside_out(name):
    inverted = 0

    @settings(max_examples=20, deadline=None, derandomize=True)
    @given(poses, st.sampled_from([0.0, 1e-3, 1e-2, 3e-2]), st.integers(0, 2**32 - 1))
    def descend(pose, size, seed):
        nonlocal inverted
        newton = pressed(name, pose, size, seed)
        inverted += newton.tissue.count_inverted(newton.displacement) > 0
        for _ in range(12):
            newton.update_relief()  # as a step begins
            energy, before = newton.energy, newton.displacement
            taken = newton.step(newton.iteration_limit)
            assert np.isfinite(newton.energy)
            assert newton.energy <= energy * (1 + 1e-11)
            # What is kept is what the displacement has.
            kept, imbalance = newton.energy, newton.residual_norm
            newton.set_displacement(newton.displacement)
            assert (newton.energy, newton.residual_norm) == pytest.approx(
                (kept, imbalance), rel=1e-9
            )
            if not taken:
                np.testing.assert_array_equal(newton.displacement, before)

    descend()
    assert inverted > 3


@EVERY
def test_the_balance_depends_on_the_pose_and_not_on_the_way_there(name):
    def balanced(*ways):
        newton = newton_of(name)
        newton.reset()
        for pose in ways:
            newton.set_pose(pose)
            for _ in range(80):
                newton.step(newton.iteration_limit)
                if newton.residual_norm <= 1e-9 * newton.contact_norm:
                    break
            if newton.update_contact():
                for _ in range(40):
                    newton.step(newton.iteration_limit)
        assert newton.residual_norm <= 1e-8 * newton.contact_norm
        return newton.displacement

    there = at(x=0.004, z=0.012, tilt=0.05)
    straight = balanced(at(x=0.004, z=0.004, tilt=0.05), there)
    round_about = balanced(at(x=-0.002, z=0.006), at(x=0.007, z=0.015, tilt=-0.05), there)
    np.testing.assert_allclose(round_about, straight, atol=1e-6)


def test_a_factor_of_the_stiffness_changes_the_way_and_not_the_end():
    ends = []
    for may_factor in (False, True):
        newton = pressed("layered", at(z=0.012))
        newton.may_factor = may_factor
        for _ in range(60):
            newton.step(200)
            if newton.residual_norm <= 1e-9 * newton.contact_norm:
                break
        ends.append(newton.displacement)
    newton_of("layered").may_factor = False
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-8)
