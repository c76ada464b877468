"""The longest stable step of an explicit method, found by trying, beside the one it predicts.

>>> from us_sim.evaluation.stability.observed_step_limit import observed_step_limit
>>> from us_sim.evaluation.stability.cases import StabilityCase
>>> predicted, observed = observed_step_limit(StabilityCase("paper's", damping=0.1))
>>> bool(abs(observed / predicted - 1) < 0.02)
True
"""

from __future__ import annotations

import math

import numpy as np

from us_sim.evaluation.stability.cases import StabilityCase, model_of
from us_sim.evaluation.stability.points import damping_factor, spring_settings
from us_sim.tissue.deformation import TissueState
from us_sim.tissue.solvers.msds import Msds, MsdsSettings

__all__ = ["observed_step_limit"]

# An amplitude so small that springs do not turn, and how much it may swell on its way: just below
# the limit by 20 times, without ever growing further; just above it grows in every step.
_AMPLITUDE, _SWELLING = 1e-8, 1e3
_STEPS = 3000

# Relative, of the bisection.
_PRECISION = 2e-3


def observed_step_limit(case: StabilityCase) -> tuple[float, float]:
    """s, the step limit that `Msds` predicts for a case without a probe, and the observed one.

    Both are infinite where every node is fixed.

    Small random displacements are let go with unscaled masses, for some thousand steps of a length
    that is bisected until it is known whether they grow.

    Raises:
        UsSimError: the case is refused.
    """
    model = model_of(case)
    nodes = model.mesh.nodes
    settings = spring_settings(case) | {"damping_factor": damping_factor(case, model)}
    shape = np.random.default_rng(1).uniform(-1.0, 1.0, nodes.shape)
    shape[model.fixed] = 0.0
    edges = nodes[model.mesh.edges]
    shape *= _AMPLITUDE * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).min()
    start = TissueState(shape, np.zeros_like(nodes))

    def grows(step: float) -> bool:
        tried = MsdsSettings(
            steps=_STEPS, time_step=step, stabilisation="none", rest_tolerance=0.0, **settings
        )
        solver = Msds(model, tried)
        solver.take_over(start)
        with np.errstate(over="ignore", invalid="ignore"):  # which is what it is to be unstable
            ended = solver.deform(None)
        moved = np.abs(ended.nodes - nodes).max()
        return bool(ended.action.startswith("the frame") or moved > _SWELLING * np.abs(shape).max())

    if model.fixed.all():
        return math.inf, math.inf
    unlimited = MsdsSettings(stabilisation="none", time_step=1e-9, **settings)
    predicted = Msds(model, unlimited).step_limit
    low, high = 0.98 * predicted, 1.02 * predicted
    while grows(low):
        low /= 2
    while not grows(high):
        high *= 2
    while high > (1 + _PRECISION) * low:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if grows(middle) else (middle, high)
    return predicted, (low * high) ** 0.5
