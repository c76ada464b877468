"""Least squares for the logarithms of moduli: the fit, its confidence, and which are determined.

Levenberg and Marquardt's damping (D. W. Marquardt, An algorithm for least-squares estimation of
nonlinear parameters, J. SIAM 11, 1963); unknowns in which the measurements are linear, such as
offsets of the sensor, are eliminated in every step (G. H. Golub and V. Pereyra, The differentiation
of pseudo-inverses and nonlinear least squares problems whose variables separate, SIAM J. Numer.
Anal. 10, 1973). Forces, torques and landmarks are weighted by the scatter that the fit finds in
each.

Residuals of neighbouring poses are alike, since a sensor drifts and a model errs alike where the
probe is alike. Standard deviations that take them for independent are too small. So the fit is
repeated, linearised, without one block of the press after the other (block jackknife; H. R. Künsch,
The jackknife and the bootstrap for general stationary observations, Ann. Statist. 17, 1989): once
with blocks of time, once with blocks of depth, and the larger variance counts. Half the interval of
a logarithm is the deviation times the quantile of Student's distribution for that many blocks.

A modulus counts as determined where its interval is narrower than a factor either way. Where some
are not, the one that is known worst is taken as given, and the rest judged anew, until all of the
rest are known: so a modulus is not refused for the uncertainty of another one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from us_sim.errors import SolverError, StiffnessError

FARTHEST = 100.0  # Factor by which a modulus may differ from the one that the fit begins with
_LONGEST_STEP = np.log(3.0)  # Of a modulus' logarithm
_MOST_STEPS = 60
_DAMPING, _MOST_DAMPING = 1e-3, 1e8
# Decrease of the sum of squares, in units of the noise's variance, that is worth no step: the
# least is then within a tenth of a standard deviation.
_SMALL_GAIN = 0.01
_SMALL_STEP = 1e-5  # Of a modulus' logarithm, likewise
_SAME_NOISE = 0.05  # Relative change of the noise that needs no new weights
# Noise of a kind of measurements over their size, below which the model's own accuracy lies.
_EXACT = 1e-5
Model = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
Progress = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class FitResult:
    """The least-squares solution."""

    log_moduli: NDArray[np.float64]  # (P,) of Pa
    nuisance: NDArray[np.float64]  # (Q,)
    residual: NDArray[np.float64]  # (n,) measured less modelled, in the measurements' units
    jacobian: NDArray[np.float64]  # (n, P) of the model
    noise: NDArray[np.float64]  # (n,) standard deviation of each measurement, by kind
    bounded: NDArray[np.bool_]  # (P,), those that ran as far as they may
    steps: int


@dataclass(eq=False)
class _State:
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
) -> FitResult:
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
            break  # the model's rounding hides any further gain
    residual = measured - here.values
    others = _nuisance_values(residual, nuisance, noise)
    bounded = (here.at <= bounds[0] + 1e-6) | (here.at >= bounds[1] - 1e-6)
    return FitResult(
        here.at, others, residual - nuisance @ others, here.slopes, noise, bounded, steps
    )


def without_nuisance(
    residual: NDArray[np.float64],
    slopes: NDArray[np.float64],
    nuisance: NDArray[np.float64],
    noise: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n,) residuals and (n, P) slopes over the noise, orthogonal to the other unknowns'."""
    left = np.column_stack([residual, slopes]) / noise[:, None]
    explained = basis(nuisance / noise[:, None])
    left -= explained @ (explained.T @ left)
    return left[:, 0], left[:, 1:]


def basis(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, R) orthonormal columns that span the same."""
    size = np.linalg.norm(columns, axis=0)
    vectors, values, _ = np.linalg.svd(columns[:, size > 0] / size[size > 0], full_matrices=False)
    return np.asarray(vectors[:, values > 1e-10 * values.max(initial=0.0)])


def _nuisance_values(residual: NDArray, nuisance: NDArray, noise: NDArray) -> NDArray:
    weighted = nuisance / noise[:, None]
    return np.asarray(np.linalg.lstsq(weighted, residual / noise, rcond=None)[0])


def _noise(
    residual: NDArray, groups: NDArray, nuisance: NDArray, measured: NDArray, moduli: int
) -> NDArray:
    """(n,) scatter of each kind of measurements, after fitting the other unknowns."""
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
    misfit: NDArray, slopes: NDArray, damping: float, at: NDArray, bounds: tuple[NDArray, NDArray]
) -> tuple[NDArray, float]:
    """(P,) the next step, and the predicted decrease of the sum of squares."""
    curvature, slope = slopes.T @ slopes, slopes.T @ misfit
    damped = curvature + np.diag(damping * np.diag(curvature) + np.finfo(np.float64).tiny)
    change = np.linalg.lstsq(damped, slope, rcond=None)[0]
    change = np.clip(change, -_LONGEST_STEP, _LONGEST_STEP)
    change = np.clip(at + change, *bounds) - at
    return change, float(2 * slope @ change - change @ curvature @ change)


# Parts of a press, one of which is left out at a time. With fewer the intervals are wider, with
# more they miss correlations that last: with 8 they hold up to about 0.8 from pose to pose.
BLOCKS = 8


def blocks(order: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """(n,) number of the block of each measurement: as many of them in each, equals together."""
    values, place = np.unique(order, return_inverse=True)
    return np.asarray((place * count) // len(values))


def jackknife(
    design: NDArray[np.float64], residual: NDArray[np.float64], part: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(U, U) covariance of the unknowns of a linear least-squares problem.

    Args:
        design: (n, U), measurements over their noise by unknowns, of full rank.
        residual: (n,) over the noise.
        part: (n,) block of each.
    """
    normal = design.T @ design
    numbers = np.unique(part)
    changes = np.empty((len(numbers), design.shape[1]))
    for k, number in enumerate(numbers):
        its = part == number
        rows = design[its]
        left = normal - rows.T @ rows
        # Without the block that alone tells an unknown, that one stays where it is.
        changes[k] = -np.linalg.lstsq(left, rows.T @ residual[its], rcond=1e-12)[0]
    changes -= changes.mean(axis=0)
    count = len(numbers)
    return np.asarray((count - 1) / count * changes.T @ changes)


def covariance(
    design: NDArray[np.float64],
    residual: NDArray[np.float64],
    times: NDArray[np.float64],
    depths: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(U,) variances: the larger of those by blocks of time and of depth.

    Args:
        design, residual: as for `jackknife`.
        times: (n,) s.
        depths: (n,) m; measurements without contact, at 0, are in blocks of time both times.
    """
    in_time = blocks(times, BLOCKS)
    touching = depths > 0.0
    in_depth = in_time + BLOCKS
    in_depth[touching] = blocks(depths[touching], BLOCKS)
    variances = [np.diag(jackknife(design, residual, part)) for part in (in_time, in_depth)]
    return np.asarray(np.maximum(*variances))


def quantile(confidence: float) -> float:
    """Half the interval of that confidence, over the standard deviation."""
    return float(student.ppf(0.5 + confidence / 2, BLOCKS - 1))


_SINGULAR = 1e-9  # Eigenvalue of the slopes' products over the largest, below which moduli are one
_LIKE = 0.3  # Share of a modulus' slope that another one must explain to be named


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Moduli that are determined, of P, and how well."""

    half_widths: NDArray[np.float64]  # (P,) of the intervals of their logarithms, the rest given
    determined: NDArray[np.bool_]  # (P,)
    felt: NDArray[np.bool_]  # (P,) whether it would be known if all others were
    like: list[list[int]]  # of each that is not determined, those that do the same


def assess_identifiability(
    fitted: FitResult,
    nuisance: NDArray[np.float64],
    times: NDArray[np.float64],
    depths: NDArray[np.float64],
    widest: float,
    confidence: float,
) -> Identifiability:
    """Tell moduli that are determined from those that are not.

    Args:
        nuisance: (n, Q) slopes by other unknowns.
        times: (n,) s.
        depths: (n,) m, of the probe, zero without contact.
        widest: factor by which a modulus may be off either way and still counts as determined.
    """
    slopes, residual, noise = fitted.jacobian, fitted.residual, fitted.noise
    _, clear = without_nuisance(residual, slopes, nuisance, noise)
    limit, times_deviation = np.log(widest), quantile(confidence)
    count = slopes.shape[1]
    sizes = np.linalg.norm(clear, axis=0)
    alone = np.divide(times_deviation, sizes, out=np.full(count, np.inf), where=sizes > 0)
    felt = alone <= limit
    kept = np.flatnonzero(felt)
    widths = alone.copy()
    while len(kept):
        widths[kept] = times_deviation * _deviations(clear[:, kept])
        if widths[kept].max() <= limit:
            unit = slopes[:, kept] / noise[:, None] / sizes[kept]
            design = np.column_stack([unit, basis(nuisance / noise[:, None])])
            variances = covariance(design, residual / noise, times, depths)[: len(kept)]
            widths[kept] = times_deviation * np.sqrt(variances) / sizes[kept]
        if widths[kept].max() <= limit:
            break
        kept = np.delete(kept, int(np.argmax(widths[kept])))
    determined = np.isin(np.arange(count), kept)
    like: list[list[int]] = [[] for _ in range(count)]
    for p in np.flatnonzero(felt & ~determined):
        like[p] = _alike(clear, int(p), kept)
    return Identifiability(widths, determined, felt, like)


def _deviations(clear: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) standard deviations of unknowns whose slopes over the noise are (n, K), if residuals
    were independent; infinite where slopes are the same.
    """
    sizes = np.linalg.norm(clear, axis=0)
    unit = clear / sizes
    values, vectors = np.linalg.eigh(unit.T @ unit)
    values = np.maximum(values, _SINGULAR * values[-1] * 1e-3)
    return np.asarray(np.sqrt((vectors**2 / values).sum(axis=1)) / sizes)


def _alike(clear: NDArray[np.float64], which: int, kept: NDArray[np.intp]) -> list[int]:
    """Kept moduli whose slopes together make up that of one, the largest parts first."""
    if len(kept) == 0:
        return []
    column = clear[:, which]
    parts = np.linalg.lstsq(clear[:, kept], column, rcond=None)[0]
    sizes = np.abs(parts) * np.linalg.norm(clear[:, kept], axis=0) / np.linalg.norm(column)
    order = np.argsort(-sizes)
    return [int(kept[k]) for k in order if sizes[k] >= _LIKE]
