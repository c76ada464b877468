"""Cases within what anatomy is, in which a probe that is held must come to balance.

>>> from us_sim.evaluation.stability.held_cases import held_cases
>>> cases = held_cases(3, seed=1)
>>> [case.case for case in cases], cases == held_cases(3, seed=1)
(['held 1.0', 'held 1.1', 'held 1.2'], True)
"""

from __future__ import annotations

import numpy as np

from us_sim.evaluation.stability.cases import LAYOUTS, StabilityCase

HOLD = 30
"""Frames in which the probe stays where its motion ended."""
SMALL = 1e-3
"""Residual that must be reached by then."""

_MESHES = ("box", "fine", "layered", "perturbed", "delaunay", "slab")
_MOTIONS = ("press", "jump", "slide", "tilt", "tremor")
_COLLIDERS = ("sphere", "capsule", "plate", "pebble")
_SUPPORTS = ("bottom", "walls")
_MODULUS = (3.0, 5.0)  # decimal logarithms of Pa, of the softest tetrahedron
_CONTRAST = (0.0, 3.0)  # decimal logarithms
_COMPRESSIBLE = (0.005, 0.2)  # 0.5 - Poisson's ratio, from 0.495 to 0.3
_DEPTH = (0.05, 0.5)  # of the thickness


def held_cases(count: int, seed: int) -> list[StabilityCase]:
    """So many cases at random; another seed gives others.

    Moduli are 1 to 100 kPa (the softest), contrasts up to 1000, Poisson's ratios 0.3 to 0.495,
    depths 5 to 50 % of the thickness; modulus, contrast and what is left to incompressibility are
    even in their logarithms.
    """
    random = np.random.default_rng(seed)

    def between(ends: tuple[float, float]) -> float:
        return float(random.uniform(*ends))

    def one_of(names: tuple[str, ...]) -> str:
        return names[int(random.integers(len(names)))]

    low, high = (float(np.log10(part)) for part in _COMPRESSIBLE)
    return [
        StabilityCase(
            case=f"held {seed}.{number}",
            young_modulus=10 ** between(_MODULUS),
            contrast=10 ** between(_CONTRAST),
            layout=one_of(LAYOUTS),
            poisson_ratio=0.5 - 10 ** between((low, high)),
            depth=between(_DEPTH),
            motion=one_of(_MOTIONS),
            mesh=one_of(_MESHES),
            support=one_of(_SUPPORTS),
            collider=one_of(_COLLIDERS),
            release=one_of(("removed", "lifted")),
            held=HOLD,
        )
        for number in range(count)
    ]
