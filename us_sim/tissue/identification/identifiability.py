"""Which moduli a press determines, and why not the others.

A modulus counts as determined where its interval is narrower than a factor either way. Where some
are not, the one that is known worst is taken as given, and the rest judged anew, until all of the
rest are known: so a modulus is not refused for what another one lacks.

>>> import numpy as np
>>> from us_sim.tissue.identification.identifiability import judge
>>> depth = np.linspace(0.0, 1.0, 60)
>>> slopes = np.column_stack([depth, 2 * depth, 1e-6 * depth, depth**2])  # of forces, N
>>> scatter = 0.01 * np.random.default_rng(1).normal(size=60)
>>> verdict = judge(slopes, scatter, np.full(60, 0.01), np.ones((60, 1)), depth, depth)
>>> verdict.determined.tolist(), verdict.felt.tolist()
([False, True, False, True], [True, True, False, True])
>>> verdict.like[0]  # what the first does to the force, the second does as well
[1]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.identification.confidence import covariance, quantile
from us_sim.tissue.identification.fit import basis, without_nuisance

_SINGULAR = 1e-9
"""Eigenvalue of the slopes' products over the largest, below which moduli are one."""

_LIKE = 0.3
"""Part of what a modulus does to the measurements that another one must do to be named."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What is known of P moduli."""

    half_widths: NDArray[np.float64]  # (P,) of the intervals of their logarithms, the rest given
    determined: NDArray[np.bool_]  # (P,)
    felt: NDArray[np.bool_]  # (P,) whether it would be known if all others were
    like: list[list[int]]  # of each that is not determined, those that do the same


def judge(
    slopes: NDArray[np.float64],
    residual: NDArray[np.float64],
    noise: NDArray[np.float64],
    nuisance: NDArray[np.float64],
    times: NDArray[np.float64],
    depths: NDArray[np.float64],
    *,
    widest: float = 3.0,
    confidence: float = 0.95,
) -> Verdict:
    """Tell moduli that are determined from others.

    Args:
        slopes: (n, P) of the measurements by the logarithms of moduli.
        residual: (n,) that the fit left.
        noise: (n,) deviation of each measurement.
        nuisance: (n, Q) slopes by other unknowns.
        times: (n,) s.
        depths: (n,) m, of the probe, zero without contact.
        widest: factor by which a modulus may be off either way and still counts as determined.
        confidence: of the intervals.
    """
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
    return Verdict(widths, determined, felt, like)


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
    """Those of the kept that together do what one does, the largest parts first."""
    if len(kept) == 0:
        return []
    column = clear[:, which]
    parts = np.linalg.lstsq(clear[:, kept], column, rcond=None)[0]
    sizes = np.abs(parts) * np.linalg.norm(clear[:, kept], axis=0) / np.linalg.norm(column)
    order = np.argsort(-sizes)
    return [int(kept[k]) for k in order if sizes[k] >= _LIKE]
