"""The linear answer of touched tissue to a probe that has moved.

>>> import numpy as np
>>> from us_sim.tissue.contact.prediction import predict_forces
>>> compliance = np.eye(6)  # of two nodes that do not know of each other
>>> down = np.array([[0.0, 0.0, 1.0]] * 2)
>>> gap = np.array([-0.5, 0.2])  # the probe has come down onto the first, and off the second
>>> held = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])
>>> predict_forces(compliance, gap, down, held, np.zeros(2), 1.0)[:, 2]
array([ 0.5, -0.2])
>>> predict_forces(compliance, gap, down, held, np.ones(2), 1.0)[:, 2]  # as soft itself
array([ 0.2 , -0.25])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.tissue.contact.complementarity import unilateral


def predict_forces(
    compliance: NDArray[np.float64],
    gap: NDArray[np.float64],
    normal: NDArray[np.float64],
    held: NDArray[np.float64],
    softness: NDArray[np.float64],
    reach: float,
) -> NDArray[np.float64]:
    """How the contact forces change, so that linear tissue obeys the law of contact again.

    Args:
        compliance: (3C, 3C) m/N of the nodes that the probe can touch.
        gap: (C,) m, to the probe where it is now; infinite where it cannot push.
        normal: (C, 3), in which it pushes.
        held: (C, 3) N, contact forces so far; all of them are replaced.
        softness: (C,) m/N, how far the probe sinks into a node that it pushes.
        reach: m, nodes with wider gaps stay untouched.

    Returns:
        (C, 3) N, the change of the forces.
    """
    touched: NDArray[np.bool_] = np.any(held != 0.0, axis=1)
    near = np.flatnonzero((touched | (gap < reach)) & np.isfinite(gap))
    loaded = np.flatnonzero(touched)
    delassus, opened = _normal_problem(compliance, near, loaded, normal, gap, held)
    delassus[np.diag_indices(len(near))] += softness[near]
    push, _ = unilateral(delassus, opened, touched[near] | (gap[near] < 0))
    change = -held
    change[near] += push[:, None] * normal[near]
    return change


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_problem(compliance, near, loaded, normal, gap, load):
    """Delassus matrix (K, K) of ``near`` nodes, and gaps (K,) with the loads taken off."""
    count = len(near)
    delassus = np.empty((count, count))
    opened = np.empty(count)
    for i in range(count):
        a = near[i]
        opened[i] = gap[a]
        for m in range(len(loaded)):
            b = loaded[m]
            for d in range(3):
                r = compliance[3 * a + d]
                s = r[3 * b] * load[b, 0] + r[3 * b + 1] * load[b, 1] + r[3 * b + 2] * load[b, 2]
                opened[i] -= normal[a, d] * s
        for j in range(i + 1):
            b = near[j]
            total = 0.0
            for d in range(3):
                r = compliance[3 * a + d]
                total += normal[a, d] * (
                    r[3 * b] * normal[b, 0]
                    + r[3 * b + 1] * normal[b, 1]
                    + r[3 * b + 2] * normal[b, 2]
                )
            delassus[i, j] = total
            delassus[j, i] = total
    return delassus, opened
