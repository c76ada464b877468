"""The contact stiffness: how the tissue's wrench on the probe changes as the probe moves.

The touched nodes stay on the probe and slide along it without friction. With f the pushes along
the normals, what the probe's motion does to gaps, normals and arms is linear, and the tissue's
answer is the compliance between the touched nodes; so the tangent is one small system of equations.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.stiffness import compute_contact_stiffness
>>> springs = np.eye(3) / 50.0  # m/N, one node
>>> pressed, force = Pose(position=[0.0, 0.0, 0.01]), np.array([[0.0, 0.0, 0.5]])
>>> at, probe = [[0.0, 0.0, 0.01]], Sphere(0.03)
>>> stiffness = compute_contact_stiffness(probe, pressed, at, force, springs, 0.02)
>>> float(stiffness[2, 2].round(6))  # N/m
50.0
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import ThreadpoolController

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.probe_gap import measure_gaps

_STEP = 1e-7  # m, of the differences by which gaps and normals are differentiated


def compute_contact_stiffness(
    collider: Collider,
    pose: Pose,
    points: ArrayLike,
    forces: NDArray[np.float64],
    compliance: NDArray[np.float64],
    spacing: float,
    surface: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> NDArray[np.float64]:
    """Compute the tangent of a frictionless contact on tissue of known compliance.

    Args:
        collider: the probe's shape.
        pose: of the probe.
        points: (K, 3) m, where it touches, in the pose's parent frame.
        forces: (K, 3) N, of the probe on the tissue there.
        compliance: (3K, 3K) m/N, between these points.
        spacing: m, between neighbours among the nodes that can be touched.
        surface: (K, 3) directions of the pushes, and (K, 3, 3) 1/m how they turn as the points
            move, where the probe does not push as `measure_gaps` says.

    Returns:
        (6, 6) N/m, N, N m: how much the wrench on the probe, force and torque about its origin
        along the parent's axes, falls with a displacement of the origin and a rotation about these
        axes. It is symmetric: of the torque it has what is left beside the turning of its arm.

    Raises:
        LinAlgError: the touched points cannot be told apart by their compliance.
    """
    points = np.asarray(points, dtype=np.float64)
    count = len(points)
    push = np.linalg.norm(forces, axis=1)
    if surface is None:
        slope, normal, turn = _surface(collider, pose, points, spacing)
    else:
        slope, normal, turn = surface[0], *surface
    arms = points - pose.position
    # Of the six motions of the probe: where its points go (3K, 6), how normals turn with it.
    carried = np.zeros((count, 3, 6))
    carried[:, :, :3] = np.eye(3)
    carried[:, :, 3:] = -_cross(arms)
    turned = np.zeros((count, 3, 6))
    turned[:, :, 3:] = -_cross(normal)
    # The points' motion y relative to the probe, pushes q: slope y = 0 and
    # y = compliance (normal q + push (turned + turn y)) - carried.
    with _threads().limit(limits=1, user_api="blas"):
        weighed = compliance.reshape(3 * count, count, 3)
        bent = np.einsum("aki,kij,k->akj", weighed, turn, push).reshape(3 * count, 3 * count)
        pushed = np.einsum("aki,ki->ak", weighed, normal)
        driven = np.einsum("aki,kij,k->aj", weighed, turned, push) - carried.reshape(-1, 6)
        answer = np.linalg.solve(np.eye(3 * count) - bent, np.hstack([pushed, driven]))
        answer = answer.reshape(count, 3, count + 6)
        opened = np.einsum("ki,kim->km", slope, answer)
        pushes = np.linalg.solve(opened[:, :count], -opened[:, count:])
    relative = answer[:, :, :count] @ pushes + answer[:, :, count:]
    change = normal[:, :, None] * pushes[:, None, :]
    change += push[:, None, None] * (turned + turn @ relative)
    moved = relative + carried
    moved[:, :, :3] -= np.eye(3)  # as seen from the probe's origin
    stiffness = np.empty((6, 6))
    stiffness[:3] = change.sum(axis=0)
    stiffness[3:] = (_cross(arms) @ change - _cross(forces) @ moved).sum(axis=0)
    return 0.5 * (stiffness + stiffness.T)


def compliance_between(
    compliance: NDArray[np.float64], nodes: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Return (3K, 3K), the part of a compliance (3S, 3S) that is between the nodes (K,)."""
    rows = (3 * nodes[:, None] + np.arange(3)).ravel()
    return compliance[np.ix_(rows, rows)]


def _surface(
    collider: Collider, pose: Pose, points: NDArray[np.float64], spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Differentiate gap and push at points (K, 3) m.

    Returns:
        The gap's slope (K, 3), the push's direction (K, 3), and how that turns as the point moves
        (K, 3, 3) 1/m.
    """
    count = len(points)
    offsets = np.concatenate([np.zeros((1, 3)), _STEP * np.eye(3), -_STEP * np.eye(3)])
    around = (points[:, None] + offsets).reshape(-1, 3)
    gap, normal = measure_gaps(collider, pose, around, spacing, np.full(len(around), spacing))
    gap, normal = gap.reshape(count, 7), normal.reshape(count, 7, 3)
    slope = (gap[:, 1:4] - gap[:, 4:7]) / (2 * _STEP)
    turn = (normal[:, 1:4] - normal[:, 4:7]).transpose(0, 2, 1) / (2 * _STEP)
    return slope, normal[:, 0], turn


def _cross(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (K, 3, 3) matrices that take any u to vector × u."""
    matrices = np.zeros((len(vectors), 3, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrices[:, c, b] = vectors[:, a]
        matrices[:, b, c] = -vectors[:, a]
    return matrices


@cache
def _threads() -> ThreadpoolController:
    """Find the BLAS libraries once, which takes milliseconds.

    Small systems take far longer on several threads than on one.
    """
    return ThreadpoolController()
