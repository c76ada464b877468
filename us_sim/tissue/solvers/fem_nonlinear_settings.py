"""What may be set of the solver ``fem_nonlinear``.

>>> from us_sim.tissue.solvers.fem_nonlinear_settings import FemNonlinearSettings
>>> FemNonlinearSettings(frame_budget="8 ms").frame_budget
0.008
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.tissue.contact.laws_of_friction import COEFFICIENT, CONTACTS
from us_sim.tissue.solvers.solver import COUNT, TOLERANCE, SolverSettings


@dataclass(frozen=True)
class FemNonlinearSettings(SolverSettings):
    """The settings of the solver ``fem_nonlinear``."""

    section = "fem_nonlinear"

    frame_tolerance: float = setting(
        TOLERANCE,
        "residual, unbalanced over contact forces, at which a frame with a moving probe ends",
        default=0.003,
    )
    frame_budget: float | None = setting(
        Quantity("time", 0.0005, 10.0),
        "time after which a frame ends with what it has, and the next goes on. Not given, 0 as a "
        "parameter: live, what the rate leaves, and up to three times that until the forces are "
        "balanced; in lockstep no limit, lest results depend on the machine",
        default=None,
    )
    most_iterations: int = setting(
        COUNT,
        "conjugate-gradient iterations of a frame at most, each step of Newton's method counting "
        "as eight more; twice as many while the probe rests",
        default=440,
    )
    tolerance: float = setting(
        TOLERANCE, "residual at which the tissue under an unmoved probe has settled", default=1e-5
    )
    contact: str = setting(
        choices=CONTACTS,
        default="frictionless",
        description="what holds between probe and tissue; sticking: a touched node keeps its place "
        "on the probe until it is let go",
    )
    friction: float = setting(
        COEFFICIENT,
        "Coulomb's coefficient, where contact is coulomb; the default is a choice, meant for gel",
        default=0.07,
    )
    viscosity: float = setting(
        Quantity("number", 0.0, 10.0),
        "stiffness that relaxes while a deformation lasts, over the one that stays: tissue gives "
        "way slowly and creeps back when it is let go; 0: none",
        default=0.0,
    )
    relaxation_time: float = setting(
        Quantity("time", 1e-3, 1e3),
        "time in which that falls to 37 percent (1/e)",
        default=0.5,
    )
    frame_interval: float = setting(
        Quantity("time", 1e-4, 10.0),
        "time that is taken to pass from one frame to the next, for viscous tissue; a frame is "
        "one pose of the probe",
        default=0.0167,
    )
