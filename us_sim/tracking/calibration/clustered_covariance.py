"""Covariance of least squares whose errors come in clusters, such as all those at one wire.

A wire is not quite where the phantom's drawing says, and neighbouring frames err alike, so a
thousand sightings tell far less than a thousand independent ones. What is assumed instead is that
errors of different clusters are independent; within one they may be related in any way. The
estimate is the sandwich of Liang and Zeger (1986) with the correction for few clusters of Bell and
McCaffrey (2002), known as CR2: residuals are smaller than errors where a cluster pulls the fit
towards itself, and are made larger by as much (Pustejovsky and Tipton 2018, equation 11).

The mean of 12 numbers in 4 clusters that are each constant is as certain as that of 4 numbers:

>>> import numpy as np
>>> from us_sim.tracking.calibration.clustered_covariance import clustered_covariance
>>> of_each = np.array([1.0, -1.0, 2.0, -2.0])
>>> residuals = np.repeat(of_each, 3)[:, None]
>>> covariance = clustered_covariance(np.ones((12, 1, 1)), residuals, np.repeat(np.arange(4), 3))
>>> np.allclose(covariance, of_each.var(ddof=1) / 4)
True
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

ENOUGH_FEATURES = 6
"""Fewer features are too few clusters: each is divided into parts of the recording."""

_PARTS = 12
"""Clusters at least, where features are divided."""

_OWN = 1e-6
"""What is left of an error in a direction that a cluster alone determines; its residual is zero."""


def cluster_numbers(features: Sequence[str]) -> NDArray[np.intp]:
    """Which cluster each sighting belongs to (N,): that of its feature, if there are enough.

    Otherwise each feature's sightings are divided, in the order in which they are given, into
    parts as long as possible: of neighbouring frames one part errs alike.
    """
    _, numbers = np.unique(np.array(features), return_inverse=True)
    count = int(numbers.max()) + 1
    if count >= ENOUGH_FEATURES:
        return numbers.astype(np.intp)
    clusters = np.zeros(len(numbers), np.intp)
    first = 0
    for number in range(count):
        own = np.flatnonzero(numbers == number)
        parts = np.array_split(own, min(-(-_PARTS // count), len(own)))
        for k, part in enumerate(parts):
            clusters[part] = first + k
        first += len(parts)
    return clusters


def clustered_covariance(
    jacobian: NDArray[np.float64], residuals: NDArray[np.float64], clusters: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(P, P) covariance of parameters that minimise the sum of squares of residuals.

    Args:
        jacobian: (N, D, P) derivatives of each observation's D residuals to the parameters, which
            they determine.
        residuals: (N, D) at the minimum.
        clusters: (N,) from 0, which cluster each observation belongs to.
    """
    size = jacobian.shape[2]
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", jacobian, jacobian))
    root = np.linalg.cholesky(inverse)
    pulls = np.empty((int(clusters.max()) + 1, size))
    for number, pull in enumerate(pulls):
        own = clusters == number
        slopes = jacobian[own].reshape(-1, size)
        left = residuals[own].ravel()
        # Of the hat matrix's block of this cluster: directions, and the leverage of each.
        directions, lengths, _ = np.linalg.svd(slopes @ root, full_matrices=False)
        larger = 1.0 / np.sqrt(np.maximum(1.0 - lengths**2, _OWN)) - 1.0
        pull[:] = slopes.T @ (left + directions @ (larger * (directions.T @ left)))
    spread: NDArray[np.float64] = inverse @ (pulls.T @ pulls) @ inverse
    return spread
