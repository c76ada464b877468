"""The evaluated tissue solvers, one entry each; solvers of other packages are not evaluated.

>>> from us_sim.evaluation.tissue_methods import TISSUE_METHODS
>>> TISSUE_METHODS["msds"].is_dynamic, TISSUE_METHODS["msds"].settings[1]
(True, {'steps': 5})
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeAlias

from us_sim.evaluation.figures import LineLook
from us_sim.evaluation.independent_forces import (
    Forces,
    compute_hooke_forces,
    compute_neo_hookean_forces,
    compute_spring_forces,
)
from us_sim.tissue.elasticity.springs import build_springs
from us_sim.tissue.model import TissueModel

Setting: TypeAlias = Mapping[str, Any]  # values of some of a solver's settings, by name


@dataclass(frozen=True)
class EvaluatedMethod:
    """One solver, and its settings in the evaluations."""

    name: str
    colour: str
    mark: str  # of its points in a plot, as Matplotlib names it
    equations: Callable[[TissueModel], Forces]  # its equations, written a second time
    variants: tuple[Setting, ...] = ()  # besides the defaults
    converging: Setting = field(default_factory=dict)  # settings with which it comes to balance
    is_dynamic: bool = False  # has masses, and a limit of stable time steps
    is_judged_at_rest: bool = False  # under a held probe it must come to balance, nothing inverted

    @property
    def settings(self) -> tuple[Setting, ...]:
        """All settings that are evaluated, the defaults first."""
        return ({}, *self.variants)


def _make_spring_equations(model: TissueModel) -> Forces:
    """Make the forces of the springs of the paper's Algorithm 1."""
    springs = build_springs(model.mesh, model.materials)
    return lambda displacement: compute_spring_forces(
        springs.edges, springs.stiffness, model.mesh.nodes, displacement
    )


def _make_solid_equations(forces: Callable[..., Any]) -> Callable[[TissueModel], Forces]:
    return lambda model: partial(forces, model.mesh, model.materials)


_ALL = (
    EvaluatedMethod(
        "fem", "#0072B2", "o", _make_solid_equations(partial(compute_hooke_forces, averaged=True))
    ),
    EvaluatedMethod(
        "fem_nonlinear",
        colour="#D55E00",
        mark="D",
        equations=_make_solid_equations(compute_neo_hookean_forces),
        is_judged_at_rest=True,
        converging={"frame_tolerance": 1e-7, "most_iterations": 4000, "tolerance": 1e-7},
        variants=(
            {"frame_tolerance": 0.3, "most_iterations": 20},
            {"frame_tolerance": 0.1, "most_iterations": 60},
            {"frame_tolerance": 0.03},
            {"frame_tolerance": 0.001, "most_iterations": 1000},
        ),
    ),
    EvaluatedMethod(
        "fem_cg",
        colour="#56B4E9",
        mark="s",
        equations=_make_solid_equations(compute_hooke_forces),
        variants=tuple({"iterations": n} for n in (5, 10, 40, 80, 160)),
    ),
    EvaluatedMethod(
        "msds",
        colour="#009E73",
        mark="^",
        equations=_make_spring_equations,
        variants=({"steps": 5}, {"steps": 80}, {"stiffness": "fitted"}),
        is_dynamic=True,
    ),
)
TISSUE_METHODS = {method.name: method for method in _ALL}
"""By name, in the reports' order; colours are distinct in every common colour blindness."""

LOOKS = {method.name: LineLook(method.colour, method.mark) for method in _ALL}
"""Look of each method's line in a figure."""
