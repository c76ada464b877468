"""The surface of a labelled structure: drawn, smoothed with its volume kept, and decimated.

>>> import numpy as np
>>> from us_sim.volume.surfaces.structure_surface import structure_surface
>>> from us_sim.volume.volume import Volume
>>> i, j, k = np.indices((40, 40, 40)) - 20.3
>>> labels = (i**2 + j**2 + k**2 < 15**2).astype(np.uint8)
>>> ball = Volume(np.zeros_like(labels), np.diag([1e-3, 1e-3, 1e-3, 1.0]), labels, {1: "cyst"})
>>> made = structure_surface(ball, 1)
>>> round(made.volume_kept, 4), made.surface.genus
(1.0, 0)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from us_sim.errors import VolumeError
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.decimation import decimated
from us_sim.volume.surfaces.settings import SurfaceSettings
from us_sim.volume.surfaces.smoothing import smoothed, with_volume
from us_sim.volume.surfaces.voxel_surface import structure_name, voxel_surface
from us_sim.volume.volume import Volume

_WAVELENGTH = 6.0
"""Voxels; the stairs of a surface that lies aslant are at most so long nearly everywhere."""

_FARTHEST = 0.5
"""Voxels by which the surface is moved to keep its volume."""


@dataclass(frozen=True, eq=False)
class StructureSurface:
    """The surface of a structure, and what was done to it."""

    name: str
    label: int
    surface: ClosedSurface
    voxels_volume: float  # m³, of the label's voxels
    drawn: int  # triangles before decimation
    moved: float  # m, largest distance that decimation moved it

    @property
    def volume_kept(self) -> float:
        """The volume inside over that of the label's voxels."""
        return self.surface.volume / self.voxels_volume


def structure_surface(
    volume: Volume, label: int, settings: SurfaceSettings | None = None
) -> StructureSurface:
    """The closed surface around a label, facing outwards, with the volume of its voxels.

    Raises:
        VolumeError: the label does not occur, its surface is not closed, or a library is missing.
    """
    settings = settings or SurfaceSettings()
    name = structure_name(volume, label)
    surface, inside = voxel_surface(volume, label)
    spacing = float(np.linalg.norm(volume.index_to_patient[:3, :3], axis=0).mean())
    wavelength = _WAVELENGTH * spacing if settings.smoothing is None else settings.smoothing
    if wavelength > 0.0:
        surface = smoothed(surface, wavelength, spacing)
    surface = with_volume(surface, inside, _FARTHEST * spacing)
    drawn, moved = len(surface.triangles), 0.0
    if settings.decimation > 0.0:
        surface, moved = decimated(surface, settings.decimation)
    if surface.fault:
        raise VolumeError(f"the surface of {name} is not closed: {surface.fault}")
    return StructureSurface(name, label, surface, inside, drawn, moved)
