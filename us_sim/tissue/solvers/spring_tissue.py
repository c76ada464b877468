"""Settings and forces that the mass-spring solvers have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.tissue.elasticity.springs import (
    SpringNetwork,
    VolumeTerm,
    fitted_springs,
    springs_of,
    volume_term,
)
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import SolverSettings


def spring_stiffness(default: str) -> Any:
    """The setting of the springs' stiffness."""
    return setting(
        choices=("algorithm_1", "fitted"),
        default=default,
        description="how springs get their stiffness: algorithm_1 is the paper's; fitted fits them "
        "to the elasticity of the same mesh, and needs no stiffness_factor",
    )


def spring_volume(default: bool) -> Any:
    """The setting of the tetrahedra's resistance."""
    return setting(
        default=default,
        description="whether tetrahedra resist changes of volume as the material does, and not "
        "only as springs do, which have Poisson's ratio 1/4",
    )


@dataclass(frozen=True)
class SpringSettings(SolverSettings):
    """The settings of every mass-spring solver.

    Raises:
        SolverError: a value is out of range, with its name and the range.
    """

    stiffness: str = spring_stiffness("algorithm_1")
    volume: bool = spring_volume(False)
    stiffness_factor: float = setting(
        Quantity("length", 1e-9, 1e3),
        "spring constant over Young's modulus, for algorithm_1",
        default=0.002,
    )
    damping_factor: float = setting(
        Quantity("time", 0.0, 1e6), "damping constant over spring constant", default=0.1
    )
    rest_tolerance: float = setting(
        Quantity("length", 0.0, 1.0),
        "motion in a frame (in 0.2 s, or in damping_factor, if these are longer) below which the "
        "tissue counts as settled",
        default=1e-6,
    )


def spring_tissue(
    model: TissueModel, settings: SpringSettings, *, yielding: bool = False
) -> tuple[SpringNetwork, VolumeTerm]:
    """The springs, without those between fixed nodes, and the volume term, as the settings say.

    Args:
        model: the tissue.
        settings: of the solver.
        yielding: as in `us_sim.tissue.elasticity.springs.volume_term`.
    """
    mesh, materials, damping = model.mesh, model.materials, settings.damping_factor
    if settings.stiffness == "fitted":
        springs = fitted_springs(mesh, materials, damping, with_volume=settings.volume)
    else:
        springs = springs_of(mesh, materials, settings.stiffness_factor, damping)
    term = VolumeTerm.nothing(len(mesh.nodes))
    if settings.volume:
        term = volume_term(mesh, materials, springs, damping, yielding=yielding)
    return springs.without(model.fixed), term
