"""Frictionless contact as a linear complementarity problem between forces p and gaps W p + g.

The linear complementarity problem 0 <= p, W p + g >= 0, p . (W p + g) = 0 is solved exactly by
principal pivoting: nodes are released by the sign of their force and added by their true gap, all
at once as long as that brings fewer of them (J. J. Judice and F. M. Pires, A block principal
pivoting algorithm for large-scale strictly monotone linear complementarity problems, Computers &
Operations Research 21, 1994), and one at a time, the least index first, when it does not, which
cannot cycle (K. G. Murty, Note on a Bard-type scheme for solving the complementarity problem,
Opsearch 11, 1974).

>>> delassus = np.array([[2.0, 1.0], [1.0, 2.0]])
>>> solve_unilateral(delassus, np.array([-2.0, 1.0]), np.zeros(2, dtype=bool))
(array([1., 0.]), array([ True, False]))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit

_BLOCK_FAILURES = 5
"""Block pivots that may fail to improve before pivots are made one at a time."""

_ROUNDING = 1e-12
"""Fraction of the largest gap below which a gap counts as closed."""

_GIVE = 1e-12
"""Fraction by which each node's own compliance is raised, so that rows that are combinations of
others have a solution; the gaps change by no larger fraction."""

_SINGLE_PIVOTS = 20  # for each unknown, before relaxation takes over
_SWEEPS = 2000  # of relaxation


def solve_unilateral(
    delassus: NDArray[np.float64], gap: NDArray[np.float64], start: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Solve 0 <= push, delassus push + gap >= 0, one of the two zero at each node.

    Redundant rows are allowed: where pushes are not unique, one solution is returned. Should
    pivots become too many, projected Gauss-Seidel takes over from there.

    Args:
        delassus: (k, k) m/N, symmetric positive semidefinite, how pushes open gaps.
        gap: (k,) m, finite, without any push.
        start: (k,) guess of which nodes are pushed, such as the last frame's.

    Returns:
        (k,) N, push, at least zero, and (k,) which nodes are pushed.
    """
    push = np.zeros(len(gap))
    active = np.array(start, dtype=np.bool_)
    if len(gap):
        solve_by_pivoting(np.ascontiguousarray(delassus), np.ascontiguousarray(gap), push, active)
    return push, active


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def solve_active(delassus, rhs, index, count, factor, out):
    """Solve delassus[index, index] x = rhs[index] by Cholesky; rows without compliance get x = 0.

    ``factor`` (k, k) and ``out`` (k,) are filled in their first ``count`` rows.
    """
    for i in range(count):
        row = factor[i]
        full = delassus[index[i]]
        for j in range(i):
            other = factor[j]
            value = full[index[j]]
            for m in range(j):
                value -= row[m] * other[m]
            row[j] = value / other[j] if other[j] > 0.0 else 0.0
        pivot = (1.0 + _GIVE) * full[index[i]]
        for m in range(i):
            pivot -= row[m] * row[m]
        row[i] = np.sqrt(pivot) if pivot > 0.0 else 0.0
        value = rhs[index[i]]
        for m in range(i):
            value -= row[m] * out[m]
        out[i] = value / row[i] if row[i] > 0.0 else 0.0
    for i in range(count - 1, -1, -1):
        value = out[i] / factor[i, i] if factor[i, i] > 0.0 else 0.0
        out[i] = value
        for m in range(i):
            out[m] -= factor[i, m] * value


@njit(cache=True, nogil=True, error_model="numpy")
def solve_by_pivoting(delassus, gap, push, active):
    """Solve as `solve_unilateral` does.

    ``push`` (k,) is filled; ``active`` (k,) comes in as the guess and goes out as the solution.
    """
    k = len(gap)
    factor = np.empty((k, k))
    solution = np.empty(k)
    index = np.empty(k, dtype=np.int64)
    opened = np.empty(k)
    wrong = np.empty(k, dtype=np.bool_)
    tolerance = _ROUNDING * np.abs(gap).max()
    fewest, failures_left, single = k + 1, _BLOCK_FAILURES, 0
    while single <= _SINGLE_PIVOTS * k:
        count = _list_active(active, index)
        solve_active(delassus, -gap, index, count, factor, solution)
        push[:] = 0.0
        heaviest = 0.0
        for m in range(count):
            push[index[m]] = solution[m]
            heaviest = max(heaviest, abs(solution[m]))
        _open(delassus, gap, index, count, push, opened)
        failures = _mark_wrong(push, opened, active, _ROUNDING * heaviest, tolerance, wrong)
        if failures == 0:
            break
        if failures < fewest:
            fewest, failures_left = failures, _BLOCK_FAILURES
        else:
            failures_left -= 1
        if failures_left <= 0:
            single += 1
            wrong[np.argmax(wrong) + 1 :] = False
        active ^= wrong
    else:
        _relax(delassus, gap, push, tolerance)
    for i in range(k):
        push[i] = max(push[i], 0.0)
        active[i] = push[i] > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _list_active(active, index):
    """Fill index with the active nodes; return their number."""
    count = np.int64(0)  # a literal would have the callees compiled for it, too
    for i in range(len(active)):
        if active[i]:
            index[count] = i
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_wrong(push, opened, active, least_push, least_gap, wrong):
    """Fill wrong (k,), where a push or a gap is below the negative tolerance; return how many."""
    count = 0
    for i in range(len(push)):
        wrong[i] = push[i] < -least_push if active[i] else opened[i] < -least_gap
        count += wrong[i]
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _open(delassus, gap, index, count, push, opened):
    """Fill opened (k,) with delassus push + gap; there are pushes at ``index`` only."""
    for i in range(len(gap)):
        opened[i] = gap[i]
    for m in range(count):
        value = push[index[m]]
        row = delassus[index[m]]
        for i in range(len(opened)):
            opened[i] += row[i] * value
        opened[index[m]] += _GIVE * row[index[m]] * value


@njit(cache=True, nogil=True, error_model="numpy")
def _relax(delassus, gap, push, tolerance):
    """Improve a guess of push (k,) by projected Gauss-Seidel."""
    k = len(gap)
    for i in range(k):
        push[i] = max(push[i], 0.0)
    for _ in range(_SWEEPS):
        change = 0.0
        for i in range(k):
            if delassus[i, i] <= 0.0:
                push[i] = 0.0
                continue
            value = gap[i]
            for j in range(k):
                value += delassus[i, j] * push[j]
            updated = max(push[i] - value / delassus[i, i], 0.0)
            change = max(change, abs(updated - push[i]) * delassus[i, i])
            push[i] = updated
        if change <= tolerance:
            return


def predict_forces(
    compliance: NDArray[np.float64],
    gap: NDArray[np.float64],
    normal: NDArray[np.float64],
    held: NDArray[np.float64],
    softness: NDArray[np.float64],
    reach: float,
) -> NDArray[np.float64]:
    """Predict how contact forces change until linear tissue obeys the law of contact again.

    >>> compliance = np.eye(6)  # of two nodes that do not know of each other
    >>> down = np.array([[0.0, 0.0, 1.0]] * 2)
    >>> gap = np.array([-0.5, 0.2])  # the probe has come down onto the first, and off the second
    >>> held = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.3]])
    >>> predict_forces(compliance, gap, down, held, np.ones(2), 1.0)[:, 2]  # as soft itself
    array([ 0.2 , -0.25])

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
    push, _ = solve_unilateral(delassus, opened, touched[near] | (gap[near] < 0))
    change = -held
    change[near] += push[:, None] * normal[near]
    return change


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_problem(compliance, near, loaded, normal, gap, load):
    """Return the Delassus matrix (K, K) of ``near`` nodes, and their gaps (K,) without loads."""
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
