"""The tangent of the contact: known springs, and differences of the solvers' wrenches."""

import numpy as np
import pytest
from tissue_block import block

from us_sim.geometry import se3
from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.stiffness import compute_contact_stiffness
from us_sim.tissue.solvers.solver import create_solver

TILTED = se3.rotation_exp(np.array([0.1, 0.05, 0.02]))


def test_a_flat_face_on_springs_of_their_own_is_their_sum():
    points = np.array([[0.01, 0, 0.002], [-0.01, 0, 0.002], [0, 0.005, 0.002], [0, -0.005, 0.002]])
    spring = np.array([100.0, 100.0, 300.0, 300.0])  # N/m
    compliance = np.diag(np.repeat(1 / spring, 3))
    forces = np.outer(0.002 * spring, [0.0, 0.0, 1.0])
    face = RoundedBox(0.06, 0.03, 0.02, 0.002)
    stiffness = compute_contact_stiffness(
        face, Pose([0, 0, 0.002]), points, forces, compliance, 0.01
    )
    expected = np.zeros((6, 6))
    expected[2, 2] = spring.sum()
    # The face turns the pushes with it, and they drag the nodes along: the torque loses
    # push times depth, beside what the springs give times the arms squared.
    load, depth = 0.002 * spring.sum(), 0.002
    expected[3, 3] = (spring * points[:, 1] ** 2).sum() - load * depth
    expected[4, 4] = (spring * points[:, 0] ** 2).sum() - load * depth
    expected[0, 4] = expected[4, 0] = load
    expected[1, 3] = expected[3, 1] = -load
    np.testing.assert_allclose(stiffness, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "collider", "frames", "step", "tolerance"),
    [
        ("fem", Sphere(0.03), 1, 1e-6, 1e-3),
        ("fem", Capsule(0.03, 0.06), 1, 1e-6, 1e-3),
        ("fem", Convex(0.07, 0.02, 0.03, 0.005, 0.06), 1, 1e-6, 1e-3),
        # That of the undeformed tissue: at 12 mm in 100 a part of what the deformed one answers.
        # It takes a node's points together, and does not say how their pushes and reliefs turn.
        ("fem_nonlinear", Sphere(0.03), 30, 1e-5, 0.16),
        ("fem_nonlinear", RoundedBox(0.06, 0.03, 0.03, 0.01), 30, 1e-5, 0.13),
    ],
)
def test_the_tangent_is_that_of_the_solvers_wrenches(name, collider, frames, step, tolerance):
    solver = create_solver(name, block((13, 9, 7), collider))
    pressed = Pose([0.003, 0.002, 0.012], TILTED)

    def wrench(twist):
        pose = Pose(
            pressed.position + twist[:3],
            se3.multiply_quaternions(se3.rotation_exp(twist[3:]), pressed.orientation),
        )
        for _ in range(frames):
            deformation = solver.deform(pose)
        return np.concatenate(
            [pose.rotation @ deformation.force, pose.rotation @ deformation.torque]
        )

    wrench(np.zeros(6))
    stiffness = solver.compute_contact_stiffness()
    steps = step * np.eye(6)
    measured = np.array([wrench(-twist) - wrench(twist) for twist in steps]).T / (2 * step)
    measured = 0.5 * (measured + measured.T)
    assert measured[2, 2] > 300  # N/m
    np.testing.assert_allclose(stiffness, measured, atol=tolerance * measured[2, 2])


@pytest.mark.parametrize("name", ["fem", "fem_nonlinear"])
def test_out_of_contact_nothing_resists(name):
    solver = create_solver(name, block())
    np.testing.assert_array_equal(solver.compute_contact_stiffness(), 0.0)
    solver.deform(Pose([0.0, 0.0, -0.01]))
    np.testing.assert_array_equal(solver.compute_contact_stiffness(), 0.0)


def test_a_solver_that_does_not_know_says_so():
    solver = create_solver("fem_cg", block())
    solver.deform(Pose([0.0, 0.0, 0.01]))
    assert solver.compute_contact_stiffness() is None
