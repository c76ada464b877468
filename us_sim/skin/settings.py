"""Settings of the skin: its surface and its membrane."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import SolverError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class MembraneSettings(Settings):
    """Settings of the membrane.

    Raises:
        SolverError: a value is out of range, with its name and the range.
    """

    section = "skin"
    error = SolverError

    stiffness: float = setting(
        Quantity("stiffness", 0.0, 1e9), "of an edge's spring", default=40.0, live=True
    )

    anchor_stiffness: float = setting(
        Quantity("stiffness", 1e-6, 1e9),
        "of the zero-length spring that ties a vertex to its place",
        default=4.0,
        live=True,
    )
    damping: float = setting(
        Quantity("number", 1.0, 1e6),
        "damping ratio of an anchored vertex: 1 is critical, and skin is overdamped",
        default=1.0,
        live=True,
    )
    density: float = setting(
        Quantity("mass per area", 1e-9, 1e6),
        "mass per area; where a vertex would be too light for a stable step its mass is raised",
        default=2.0,
        live=True,
    )
    prestrain: float = setting(
        Quantity("number", 0.0, 0.999), "of the springs at rest", default=0.2, live=True
    )
    time_step: float = setting(Quantity("time", 1e-9, 10.0), "of a step", default=0.01, live=True)
    steps: int = setting(
        Quantity("number", 1, 400),
        "in a frame; a probe that moves far takes more",
        default=10,
        live=True,
    )


@dataclass(frozen=True)
class SkinSettings(MembraneSettings):
    """The skin of a scene: a surface file, or a sheet bent down on both sides of a flat part."""

    file: str | None = setting(
        description="surface in place of the sheet: Wavefront OBJ, STL, PLY or VTK",
        default=None,
        file=True,
    )
    size: tuple[float, float] = setting(
        Quantity("length", 0.01, 2.0), "of the sheet across and along", default=(0.2, 0.2)
    )
    spacing: float = setting(
        Quantity("length", 5e-4, 0.05), "between the sheet's vertices", default=4e-3
    )
    flat_width: float = setting(
        Quantity("length", 0.0, 2.0), "of the sheet's flat part", default=2.0
    )
    radius: float = setting(
        Quantity("length", 5e-3, 10.0), "with which the sheet bends down beside it", default=0.05
    )
