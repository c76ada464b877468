"""The evaluated tissue solvers, one entry each; those of other packages are not evaluated.

>>> from us_sim.evaluation.tissue_methods import TISSUE_METHODS
>>> TISSUE_METHODS["msds"].has_springs, TISSUE_METHODS["fem"].equations({"threads": 2})
(True, ('fem',))
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from us_sim.evaluation.figures import Look
from us_sim.evaluation.independent_forces import (
    averaged_hooke_forces,
    hooke_forces,
    neo_hookean_forces,
)
from us_sim.evaluation.independent_residual import Residual, solid_residual, spring_residual

Setting = Mapping[str, Any]  # values of some of a solver's settings, by name

_EFFORT = (
    *("iterations", "steps", "threads", "contact_updates", "time_step"),
    *("frame_tolerance", "frame_budget", "tolerance", "most_iterations"),
)
"""Settings that say how long a method tries, and not which equations it solves."""


@dataclass(frozen=True)
class TissueMethod:
    """One solver."""

    name: str
    colour: str
    mark: str  # of its points in a plot, as Matplotlib names it
    residual: Residual  # its equations, written down again
    patient: Setting | None  # settings with which it converges; None where it solves directly
    tried: tuple[Setting, ...] = ()  # besides the defaults
    has_springs: bool = False
    is_quasi_static: bool = True  # without masses: a free tissue has no position of rest
    is_explicit: bool = False  # only time steps up to a limit are stable
    is_judged_at_rest: bool = False  # under a held probe it must come to balance, nothing inverted
    families: Mapping[str, str] = field(default_factory=dict)
    """Names in plots of settings that change the equations."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """All that are tried, the defaults first."""
        return ({}, *self.tried)

    def equations(self, setting: Setting) -> tuple[Any, ...]:
        """Key of the equations: alike for settings that approach the same solution."""
        return (self.name, *sorted(self.without_effort(setting).items()))

    @staticmethod
    def without_effort(setting: Setting) -> dict[str, Any]:
        """The part of a setting that decides which equations are solved."""
        return {name: value for name, value in setting.items() if name not in _EFFORT}

    def family(self, setting: str) -> str:
        """Difference of a setting's equations, written ``a=1, b=2``, from the default's."""
        parts = (self.families.get(part) for part in setting.split(", "))
        return ", ".join(part for part in parts if part)


_OF_SPRINGS = {
    "stiffness=fitted": "fitted",
    "stiffness=algorithm_1": "Algorithm 1",
    "volume=True": "volume term",
    "volume=False": "no volume term",
}

_ALL = (
    TissueMethod("fem", "#0072B2", "o", solid_residual(averaged_hooke_forces), patient=None),
    TissueMethod(
        "fem_nonlinear",
        colour="#D55E00",
        mark="D",
        residual=solid_residual(neo_hookean_forces, surface=True),
        is_judged_at_rest=True,
        patient={"frame_tolerance": 1e-7, "most_iterations": 4000, "tolerance": 1e-7},
        tried=(
            {"frame_tolerance": 0.3, "most_iterations": 20},
            {"frame_tolerance": 0.1, "most_iterations": 60},
            {"frame_tolerance": 0.03},
            {"frame_tolerance": 0.001, "most_iterations": 1000},
        ),
    ),
    TissueMethod(
        "fem_cg",
        colour="#56B4E9",
        mark="s",
        residual=solid_residual(hooke_forces),
        patient={"iterations": 500, "tolerance": 1e-9},
        tried=tuple({"iterations": n} for n in (5, 10, 40, 80, 160)),
    ),
    TissueMethod(
        "msds",
        colour="#009E73",
        mark="^",
        residual=spring_residual,
        patient={"steps": 100, "rest_tolerance": 1e-8},
        tried=(
            {"steps": 5},
            {"steps": 80},
            {"stiffness": "fitted"},
            {"stiffness": "fitted", "volume": True},
            {"stiffness": "fitted", "volume": True, "steps": 80},
        ),
        has_springs=True,
        is_quasi_static=False,
        is_explicit=True,
        families=_OF_SPRINGS,
    ),
)
TISSUE_METHODS = {method.name: method for method in _ALL}
"""By name, in the reports' order; colours are told apart in every common colour blindness."""

LOOKS = {method.name: Look(method.colour, method.mark) for method in _ALL}
"""Of each method's line in a figure."""
