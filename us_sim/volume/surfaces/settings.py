"""How surfaces are made of labels."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class SurfaceSettings(Settings):
    """How surfaces are made of labels."""

    section = "surfaces"
    error = VolumeError

    smoothing: float | None = setting(
        Quantity("length", 0.0, 0.1),
        "bumps of a surface that are shorter than this are taken away, 0 for none; six voxels "
        "where not given",
        default=None,
    )
    decimation: float = setting(
        Quantity("number", 0.0, 0.99),
        "part of the triangles that is joined with others, 0 for none",
        default=0.0,
    )
