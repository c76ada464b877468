"""Least squares for the logarithms of moduli, offsets of the sensor beside them.

Levenberg and Marquardt's damping (D. W. Marquardt, An algorithm for least-squares estimation of
nonlinear parameters, J. SIAM 11, 1963); what the measurements are linear in is eliminated in every
step (G. H. Golub and V. Pereyra, The differentiation of pseudo-inverses and nonlinear least squares
problems whose variables separate, SIAM J. Numer. Anal. 10, 1973). Forces, torques and landmarks are
weighted by the scatter that the fit finds in each.

>>> import numpy as np
>>> from us_sim.tissue.identification.fit import fit
>>> depth = np.linspace(0.0, 1.0, 20)
>>> def felt(log_moduli):  # the stiffness of two layers in series, of 1 and 2 units alone
...     soft, firm = 1 / np.exp(log_moduli)
...     force = depth / (soft + firm / 2) + depth**2 * np.exp(log_moduli[0])
...     by_series = depth / (soft + firm / 2) ** 2
...     slopes = [by_series * soft + depth**2 * np.exp(log_moduli[0]), by_series * firm / 2]
...     return force, np.column_stack(slopes)
>>> measured = felt(np.log([3.0, 12.0]))[0] + 0.5
>>> found = fit(felt, measured, np.zeros(20, int), np.ones((20, 1)), np.zeros(2))
>>> np.exp(found.log_moduli).round(4), found.nuisance.round(6)
(array([ 3., 12.]), array([0.5]))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SolverError, StiffnessError

FARTHEST = 100.0
"""Factor by which a modulus may differ from the one that the fit begins with."""

_LONGEST_STEP = np.log(3.0)
"""Of a modulus' logarithm."""

_MOST_STEPS = 60
_DAMPING, _MOST_DAMPING = 1e-3, 1e8
_SMALL_GAIN = 0.01
"""Decrease of the sum of squares, in units of the noise's variance, that is worth no step: the
least is then within a tenth of a standard deviation."""

_SMALL_STEP = 1e-5
"""Of a modulus' logarithm, likewise."""

_SAME_NOISE = 0.05
"""Relative change of the noise that needs no new weights."""

_EXACT = 1e-5
"""Noise of a kind of measurements over their size, below which the model's own accuracy lies."""

Model = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
Progress = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class Fitted:
    """Where the sum of squares is least."""

    log_moduli: NDArray[np.float64]  # (P,) of Pa
    nuisance: NDArray[np.float64]  # (Q,)
    residual: NDArray[np.float64]  # (n,) measured less modelled, in the measurements' units
    jacobian: NDArray[np.float64]  # (n, P) of the model
    noise: NDArray[np.float64]  # (n,) standard deviation of each measurement, by kind
    bounded: NDArray[np.bool_]  # (P,), those that ran as far as they may
    steps: int


@dataclass(eq=False)
class _State:
    """A point and its model."""

    at: NDArray[np.float64]
    values: NDArray[np.float64]
    slopes: NDArray[np.float64]


def fit(
    model: Model,
    measured: NDArray[np.float64],
    groups: NDArray[np.intp],
    nuisance: NDArray[np.float64],
    start: NDArray[np.float64],
    progress: Progress | None = None,
) -> Fitted:
    """The logarithms of moduli that fit best.

    Args:
        model: (n,) values and (n, P) slopes, at (P,) logarithms of moduli.
        measured: (n,).
        groups: (n,) kinds of measurements, which have a noise of their own.
        nuisance: (n, Q), how the measurements change with each other unknown.
        start: (P,).
        progress: told the number of the step that is made, and the misfit.

    Raises:
        StiffnessError: no end is found.
        SolverError: the model has no answer where the fit begins.
    """
    bounds = start - np.log(FARTHEST), start + np.log(FARTHEST)
    here = _State(start.copy(), *model(start))
    noise = _noise(measured - here.values, groups, nuisance, measured, len(start))
    damping, steps = _DAMPING, 0
    while True:
        misfit, slopes = without_nuisance(measured - here.values, here.slopes, nuisance, noise)
        cost = float(misfit @ misfit)
        if progress is not None:
            progress(float(steps), f"misfit {np.sqrt(cost / len(measured)):.3g}")
        change, gain = _step(misfit, slopes, damping, here.at, bounds)
        if gain < _SMALL_GAIN or np.abs(change).max(initial=0.0) < _SMALL_STEP:
            renewed = _noise(measured - here.values, groups, nuisance, measured, len(start))
            if np.all(np.abs(renewed / noise - 1.0) < _SAME_NOISE):
                break
            noise, damping = renewed, _DAMPING
            steps += 1
            continue
        steps += 1
        if steps > _MOST_STEPS:
            raise StiffnessError(
                f"the fit has no end after {_MOST_STEPS} steps: begin nearer, with other moduli in "
                f"the scene, or keep some of them"
            )
        try:
            there = _State(here.at + change, *model(here.at + change))
        except (SolverError, StiffnessError):
            there = None
        if there is not None:
            reached, _ = without_nuisance(measured - there.values, there.slopes, nuisance, noise)
            if float(reached @ reached) < cost:
                here, damping = there, max(damping / 10, 1e-9)
                continue
        damping = 10 * max(damping, _DAMPING)
        if damping > _MOST_DAMPING:
            break  # rounding of the model hides what is left to gain
    residual = measured - here.values
    others = _others(residual, nuisance, noise)
    bounded = (here.at <= bounds[0] + 1e-6) | (here.at >= bounds[1] - 1e-6)
    return Fitted(here.at, others, residual - nuisance @ others, here.slopes, noise, bounded, steps)


def without_nuisance(
    residual: NDArray[np.float64],
    slopes: NDArray[np.float64],
    nuisance: NDArray[np.float64],
    noise: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n,) residuals and (n, P) slopes over the noise, less what the other unknowns explain."""
    left = np.column_stack([residual, slopes]) / noise[:, None]
    explained = basis(nuisance / noise[:, None])
    left -= explained @ (explained.T @ left)
    return left[:, 0], left[:, 1:]


def basis(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, R) orthonormal columns that span the same."""
    size = np.linalg.norm(columns, axis=0)
    vectors, values, _ = np.linalg.svd(columns[:, size > 0] / size[size > 0], full_matrices=False)
    return np.asarray(vectors[:, values > 1e-10 * values.max(initial=0.0)])


def _others(
    residual: NDArray[np.float64], nuisance: NDArray[np.float64], noise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(Q,) the other unknowns that leave least."""
    weighted = nuisance / noise[:, None]
    return np.asarray(np.linalg.lstsq(weighted, residual / noise, rcond=None)[0])


def _noise(
    residual: NDArray[np.float64],
    groups: NDArray[np.intp],
    nuisance: NDArray[np.float64],
    measured: NDArray[np.float64],
    moduli: int,
) -> NDArray[np.float64]:
    """(n,) scatter of each kind of measurements, of what the other unknowns leave."""
    noise = np.empty(len(residual))
    free = (len(residual) - nuisance.shape[1] - moduli) / len(residual)
    for group in np.unique(groups):
        its = groups == group
        explained = basis(nuisance[its])
        left = residual[its] - explained @ (explained.T @ residual[its])
        size = float(np.sqrt((measured[its] ** 2).mean())) or 1.0
        scatter = float(np.sqrt((left**2).mean() / max(free, 0.1)))
        noise[its] = max(scatter, _EXACT * size)
    return noise


def _step(
    misfit: NDArray[np.float64],
    slopes: NDArray[np.float64],
    damping: float,
    at: NDArray[np.float64],
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> tuple[NDArray[np.float64], float]:
    """(P,) the next step, and how much the sum of squares would fall by it if all were linear."""
    curvature, slope = slopes.T @ slopes, slopes.T @ misfit
    damped = curvature + np.diag(damping * np.diag(curvature) + np.finfo(np.float64).tiny)
    change = np.linalg.lstsq(damped, slope, rcond=None)[0]
    change = np.clip(change, -_LONGEST_STEP, _LONGEST_STEP)
    change = np.clip(at + change, *bounds) - at
    return change, float(2 * slope @ change - change @ curvature @ change)
