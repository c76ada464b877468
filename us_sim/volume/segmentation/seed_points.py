"""Which voxels a person's points are in, and the part of a volume that is looked at around them.

>>> import numpy as np
>>> from us_sim.volume.segmentation.seed_points import box_of, seeds_of
>>> from us_sim.volume.segmentation.settings import StructureSeeds
>>> from us_sim.volume.volume import Volume
>>> spacing = np.full(3, 0.5e-3)
>>> volume = Volume(np.zeros((40, 40, 40), np.uint8), np.diag([*spacing, 1.0]))
>>> asked = StructureSeeds(seeds_mm=[[10, 5, 2.5]], reach="2 mm")
>>> seeds = seeds_of(volume, "vein", asked)
>>> seeds, box_of(volume, "vein", asked, seeds, spacing)[0]
([(20, 10, 5)], slice(15, 26, None))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.segmentation.region import Index
from us_sim.volume.segmentation.settings import StructureSeeds
from us_sim.volume.volume import Volume


def seeds_of(volume: Volume, name: str, asked: StructureSeeds) -> list[Index]:
    """Indices of the voxels that a structure's seeds lie in.

    Raises:
        VolumeError: one is outside the volume.
    """
    placed = _indices(volume, name, "seeds_mm", asked.seeds_mm)
    for number, index in enumerate(asked.seeds_voxel):
        if not all(n < size for n, size in zip(index, volume.shape, strict=True)):
            size = " × ".join(map(str, volume.shape))
            raise VolumeError(
                f"structures.{name}.seeds_voxel[{number}]: {list(index)} is outside the volume of "
                f"{size} voxels"
            )
        placed.append(index)
    return placed


def outside_of(volume: Volume, name: str, asked: StructureSeeds) -> list[Index]:
    """Indices of the voxels that are known not to be in a structure.

    Raises:
        VolumeError: one is outside the volume.
    """
    return _indices(volume, name, "outside_mm", asked.outside_mm)


def _indices(
    volume: Volume, name: str, key: str, points: tuple[tuple[float, float, float], ...]
) -> list[Index]:
    """Indices of the voxels that points in mm lie in."""
    found: list[Index] = []
    for number, point in enumerate(points):
        at = volume.patient_to_index @ [*(1e-3 * np.array(point)), 1.0]
        i, j, k = (int(n) for n in np.floor(at[:3] + 0.5))
        if not all(0 <= n < size for n, size in zip((i, j, k), volume.shape, strict=True)):
            low, high = volume.extent * 1e3
            spans = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in zip(low, high, strict=True))
            raise VolumeError(
                f"structures.{name}.{key}[{number}]: {list(point)} mm is outside the volume, which "
                f"spans {spans} mm; points of a program that shows right-anterior-superior axes "
                f"have their first two signs turned"
            )
        found.append((i, j, k))
    return found


def box_of(
    volume: Volume,
    name: str,
    asked: StructureSeeds,
    seeds: list[Index],
    spacing: NDArray[np.float64],
) -> tuple[slice, ...]:
    """The part of the volume that is looked at, around all seeds.

    Raises:
        VolumeError: the volume is not in it, or a seed is not.
    """
    first, last = np.zeros(3, dtype=int), np.array(volume.shape)
    if asked.reach is not None:
        away = np.ceil(asked.reach / spacing).astype(int) + 1
        first = np.maximum(first, np.min(seeds, axis=0) - away)
        last = np.minimum(last, np.max(seeds, axis=0) + away + 1)
    if asked.within_mm is not None:
        low, high = 1e-3 * np.array(asked.within_mm)
        corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1)
        corners = np.c_[corners.reshape(-1, 3), np.ones(8)] @ volume.patient_to_index.T
        first = np.maximum(first, np.floor(corners[:, :3].min(axis=0)).astype(int))
        last = np.minimum(last, np.ceil(corners[:, :3].max(axis=0)).astype(int) + 1)
    if (first >= last).any():
        raise VolumeError(f"structures.{name}.within_mm: the volume is nowhere in this box")
    for number, seed in enumerate(seeds):
        if not ((np.array(seed) >= first) & (np.array(seed) < last)).all():
            raise VolumeError(
                f"structures.{name}.within_mm: seed {number + 1} is outside this box: make it "
                f"larger"
            )
    return tuple(slice(int(a), int(b)) for a, b in zip(first, last, strict=True))
