"""Noise that is a function of where and when: the same in every run, whatever came before.

Numbers are hashed with the finaliser of SplitMix64 (G. L. Steele, D. Lea, C. H. Flood, Fast
splittable pseudorandom number generators, OOPSLA 2014).

>>> import numpy as np
>>> from us_sim.slicing.flow.noise import normal_pair, uniform
>>> pairs = np.array([normal_pair(np.uint64(7), np.uint64(k)) for k in range(4000)])
>>> bool(abs(pairs.mean()) < 0.05), bool(abs(pairs.std() - 1.0) < 0.05)
(True, True)
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit

_STEP = np.uint64(0x9E3779B97F4A7C15)
_FIRST, _SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


@njit(cache=True, nogil=True, error_model="numpy")
def uniform(seed, place):
    """A number above 0, and at most 1, for two numbers of type uint64."""
    x = (seed * _STEP) ^ (place + _STEP)
    for _ in range(2):
        x = (x ^ (x >> np.uint64(30))) * _FIRST
        x = (x ^ (x >> np.uint64(27))) * _SECOND
        x = (x ^ (x >> np.uint64(31))) + _STEP
    return (np.float64(x >> np.uint64(11)) + 1.0) * (1.0 / 9007199254740992.0)


@njit(cache=True, nogil=True, error_model="numpy")
def normal_pair(seed, place):
    """Two independent normal numbers (G. E. P. Box, M. E. Muller, 1958)."""
    size = np.sqrt(-2.0 * np.log(uniform(seed, place)))
    angle = 2.0 * np.pi * uniform(seed ^ _SECOND, place)
    return size * np.cos(angle), size * np.sin(angle)
