"""The longest stable step of symplectic Euler, and what makes a longer one stable.

A mode of circular frequency w, damped by b times its stiffness, is multiplied in a step of dt by a
root of z**2 - (2 - b w**2 dt - w**2 dt**2) z + 1 - b w**2 dt. Both roots are inside the unit circle
(E. I. Jury's conditions) if and only if dt**2 + 2 b dt < 4 / w**2.

Two masses of 2 kg joined by 100 N/m swing against each other at 10 rad/s:

>>> import numpy as np
>>> from us_sim.tissue.elasticity.springs import SpringNetwork
>>> from us_sim.tissue.elasticity.step_limit import highest_frequency, step_limit
>>> nodes, one = np.array([[0.0, 0, 0], [1, 0, 0]]), np.ones(1)
>>> springs = SpringNetwork(np.array([[0, 1]], dtype=np.int32), 100 * one, 0 * one, one)
>>> frequency = highest_frequency([springs.factor(nodes)], np.full(2, 2.0), np.zeros(2, bool))
>>> f"{step_limit(frequency, 0.0):.6f} s, damped {step_limit(frequency, 0.1):.6f} s"
'0.200000 s, damped 0.123607 s'
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack
from scipy.sparse.linalg import LinearOperator, eigsh

from us_sim.errors import SolverError
from us_sim.tissue.model import TissueModel

_MARGIN = 1.05
"""Safety factor of masses and sub-steps on Gershgorin's bound of stability."""

_TOLERANCE = 1e-4  # relative, of the square of the highest frequency


def step_limit(frequency: float, damping_factor: float) -> float:
    """s, the longest stable step of symplectic Euler for stiffness-proportional damping.

    Args:
        frequency: the highest one, 1/s.
        damping_factor: s, damping constant over stiffness.
    """
    span = 4 / frequency**2
    return span / (damping_factor + math.sqrt(damping_factor**2 + span))


def highest_frequency(
    factors: Sequence[csr_array], mass: NDArray[np.float64], fixed: NDArray[np.bool_]
) -> float:
    """1/s, the largest circular frequency of small undamped oscillations.

    By Lanczos iterations on the largest generalised eigenvalue of stiffness and mass, to 1e-4.

    Args:
        factors: B (rows, 3N) of each kind of force, whose B'B add up to the stiffness.
        mass: (N,) kg.
        fixed: (N,), held nodes.
    """
    scale = np.repeat(np.where(fixed, 0.0, 1 / np.sqrt(mass)), 3)
    free = np.repeat(~fixed, 3)
    factor = csr_array(vstack(factors).multiply(scale).tocsc()[:, free])
    size = factor.shape[1]
    if size <= 30:
        return math.sqrt(max(np.linalg.eigvalsh((factor.T @ factor).toarray())[-1], 0.0))
    back = factor.T.tocsr()
    product = LinearOperator((size, size), matvec=lambda v: back @ (factor @ v), dtype=float)
    start = np.random.default_rng(0).standard_normal(size)
    largest = eigsh(product, k=1, which="LA", v0=start, tol=_TOLERANCE, return_eigenvectors=False)
    return math.sqrt(largest[0])


def node_stiffness(factors: Sequence[csr_array]) -> NDArray[np.float64]:
    """(N,) N/m, d such that the stiffness is nowhere above 2 diag(d) (S. Gershgorin's bound).

    For springs alone it is the sum of a node's spring constants, which holds however they turn and
    stretch. With or without a volume term it is about 2.7 times what the undeformed tissue needs.

    Args:
        factors: as in `highest_frequency`.
    """
    count = factors[0].shape[1] // 3
    axes = np.repeat(np.arange(count), 3), np.arange(3 * count)
    merge = csr_array((np.ones(3 * count), axes[::-1]), shape=(3 * count, count))
    total = np.zeros(count)
    for factor in factors:
        size = csr_array(factor.multiply(factor) @ merge).sqrt()
        total += 0.5 * (size.T @ np.asarray(size.sum(axis=1)).ravel())
    return total


def stabilised(
    model: TissueModel,
    factors: Sequence[csr_array],
    time_step: float,
    damping_factor: float,
    stabilisation: str,
    maximum_substeps: int,
) -> tuple[NDArray[np.float64], int, str]:
    """Masses (N,) kg and number of sub-steps that make a step stable, and what was done, in words.

    They follow from the bound of `node_stiffness`, so that the step stays stable as the tissue
    deforms. The limit in the words is the one of small oscillations.

    Args:
        model: whose lumped masses are simulated where possible.
        factors: as in `highest_frequency`.
        time_step: s, as set.
        damping_factor: s, damping constant over stiffness.
        stabilisation: ``mass_scaling``, ``substeps``, or ``none``, which only says what it is.
        maximum_substeps: of one step.

    Raises:
        SolverError: more sub-steps than allowed.
    """
    mass, free = model.lumped_mass, ~model.fixed
    if not free.any():
        return mass, 1, ""
    stiffness = node_stiffness(factors)
    span = time_step**2 + 2 * damping_factor * time_step
    needed = 0.5 * _MARGIN * span * stiffness
    if not (needed > mass)[free].any():
        return mass, 1, ""
    limit = step_limit(highest_frequency(factors, mass, model.fixed), damping_factor)
    unstable = f"steps beyond {1e3 * limit:.2g} ms are unstable"
    if stabilisation == "none":
        return mass, 1, unstable
    if stabilisation == "mass_scaling":
        scaled = np.maximum(mass, needed)
        factor = (scaled / mass)[free]
        low, high = factor.min(), factor.max()
        return scaled, 1, f"masses scaled {low:.0f} to {high:.0f} times: unscaled, {unstable}"
    bound = math.sqrt(2 * _MARGIN * (stiffness / mass)[free].max())
    substeps = math.ceil(time_step / step_limit(bound, damping_factor))
    if substeps > maximum_substeps:
        raise SolverError(
            f"msds needs {substeps} sub-steps for each step of {1e3 * time_step:g} ms, more than "
            f"maximum_substeps = {maximum_substeps}: use stabilisation mass_scaling, or lower "
            f"damping_factor"
        )
    return mass, substeps, f"{substeps} sub-steps a step: undivided, {unstable}"
