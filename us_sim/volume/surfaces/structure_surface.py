"""The surface of a labelled structure, with the volume of its voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from us_sim.geometry.triangles import vertex_normals
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.label_surface import label_surface
from us_sim.volume.volume import Volume


@dataclass(frozen=True, eq=False)
class StructureSurface:
    """The surface of a structure."""

    name: str
    surface: ClosedSurface
    voxels_volume: float  # m³, of the label's voxels

    @property
    def volume_kept(self) -> float:
        """The volume inside over that of the label's voxels."""
        return self.surface.volume / self.voxels_volume


def structure_surface(volume: Volume, label: int) -> StructureSurface:
    """Draw the closed surface around a label, facing outwards, with the volume of its voxels.

    Raises:
        VolumeError: the label does not occur.
    """
    surface = ClosedSurface(*label_surface(volume, label))
    matrix = volume.index_to_patient[:3, :3]
    inside = abs(float(np.linalg.det(matrix))) * np.count_nonzero(volume.labels == label)
    half = 0.5 * float(np.linalg.norm(matrix, axis=0).mean())
    name = volume.label_names.get(label, f"label {label}")
    return StructureSurface(name, with_volume(surface, inside, half), inside)


def with_volume(surface: ClosedSurface, volume: float, farthest: float) -> ClosedSurface:
    """Move all vertices alike along their normals until the surface encloses a volume.

    Args:
        surface: closed, facing outwards.
        volume: m³.
        farthest: m; no vertex is moved farther, so a surface may stop short of the volume.
    """
    normals = vertex_normals(surface.vertices, surface.triangles)
    moved, distance = surface, 0.0
    for _ in range(4):  # Newton steps; each leaves the square of the error before
        missing = volume - moved.volume
        if abs(missing) <= 1e-6 * volume:
            break
        distance = float(np.clip(distance + missing / moved.area, -farthest, farthest))
        moved = ClosedSurface(surface.vertices + distance * normals, surface.triangles)
    return moved
