"""How well fitted moduli are known: by leaving out a part of the press at a time.

Residuals of neighbouring poses are alike, since a sensor drifts and a model errs alike where the
probe is alike. Standard deviations that take them for independent are too small. So the fit is
repeated, linearised, without one block of the press after the other (block jackknife; H. R. Künsch,
The jackknife and the bootstrap for general stationary observations, Ann. Statist. 17, 1989): once
with blocks of time, once with blocks of depth, and the larger variance counts. Half the interval of
a logarithm is the deviation times the quantile of Student's distribution for that many blocks.

>>> import numpy as np
>>> from us_sim.tissue.identification.confidence import blocks, jackknife
>>> noise = np.random.default_rng(0).normal(size=400)
>>> part = blocks(np.arange(400.0), 10)
>>> alone = jackknife(np.ones((400, 1)), noise, part)[0, 0]
>>> alike = jackknife(np.ones((400, 1)), np.repeat(noise[:40], 10), part)[0, 0]
>>> float(round(400 * alone, 1)), float(round(400 * alike, 1))  # ten alike count as one
(1.0, 10.6)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

BLOCKS = 8
"""Parts of a press, one of which is left out at a time. With fewer the intervals are wider, with
more they miss correlations that last: with 8 they hold up to about 0.8 from pose to pose."""


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
