"""The longest stable step of an explicit method, found by trying, beside the one it predicts.

>>> from us_sim.evaluation.stability.observed_step_limit import observed_step_limit
>>> from us_sim.evaluation.stability.cases import StabilityCase
>>> predicted, observed = observed_step_limit("msds", StabilityCase("paper's", damping=0.1))
>>> bool(abs(observed / predicted - 1) < 0.02)
True
"""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from us_sim.evaluation.stability.cases import StabilityCase, model_of
from us_sim.evaluation.stability.points import damping_factor, spring_settings
from us_sim.settings.quantity import Quantity
from us_sim.settings.registry import SOLVERS
from us_sim.settings.setting import rules_of
from us_sim.tissue.deformation import Intervention, TissueState
from us_sim.tissue.solvers.solver import create_solver

_AMPLITUDE = 1e-8
"""First displacements over the shortest edge: so small that springs do not turn."""
_SWELLING = 1e3
"""Growth that shows instability. Just below the limit amplitudes swell by 20 times and stay so."""
_STEPS = 3000
_PRECISION = 2e-3  # relative, of the bisection


def observed_step_limit(method: str, case: StabilityCase) -> tuple[float, float]:
    """s, the step limit that a solver predicts for a case without a probe, and the observed one.

    Both are infinite where every node is fixed, or the limit is none that can be set.

    Small random displacements are let go with unscaled masses, for some thousand steps of a length
    that is bisected until it is known whether they grow.

    Raises:
        UsSimError: the case is refused.
    """
    model = model_of(case)
    nodes = model.mesh.nodes
    settings: dict[str, Any] = asdict(spring_settings(case))
    settings |= {"damping_factor": damping_factor(case, model), "stabilisation": "none"}
    shape = np.random.default_rng(1).uniform(-1.0, 1.0, nodes.shape)
    shape[model.fixed] = 0.0
    edges = nodes[model.mesh.edges]
    shape *= _AMPLITUDE * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).min()
    start = TissueState(shape, np.zeros_like(nodes))

    def grows(step: float) -> bool:
        going_on = {"steps": _STEPS, "rest_tolerance": 0.0, **settings}
        solver = create_solver(method, model, time_step=step, **going_on)
        solver.take_over(start)
        with np.errstate(over="ignore", invalid="ignore"):  # which is what it is to be unstable
            ended = solver.deform(None)
        moved = np.abs(ended.nodes - nodes).max()
        return bool(
            Intervention.FRAME_FAILED in ended.interventions
            or moved > _SWELLING * np.abs(shape).max()
        )

    if model.fixed.all():
        return math.inf, math.inf
    solver: Any = create_solver(method, model, time_step=1e-9, **settings)
    predicted = float(solver.step_limit)
    can_be_set = rules_of(SOLVERS.settings(method))["time_step"].quantity or Quantity("time")
    low, high = 0.98 * predicted, 1.02 * predicted
    if not can_be_set.minimum < low < high < can_be_set.maximum:
        return math.inf, math.inf
    while low > 2 * can_be_set.minimum and grows(low):
        low /= 2
    while high < can_be_set.maximum / 2 and not grows(high):
        high *= 2
    while high > (1 + _PRECISION) * low:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if grows(middle) else (middle, high)
    return predicted, (low * high) ** 0.5
