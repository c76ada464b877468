"""Structures of a volume, each grown from its seeds, put together into labels."""

from __future__ import annotations

import numpy as np
import SimpleITK
from numpy.typing import NDArray
from scipy import ndimage

from us_sim import Progress
from us_sim.errors import VolumeError
from us_sim.volume.segmentation.settings import SegmentationSettings, StructureSeeds
from us_sim.volume.volume import LabelMap, Volume


def segment_volume(
    volume: Volume, settings: SegmentationSettings, progress: Progress = lambda *_: None
) -> LabelMap:
    """Find the labels of structures, numbered in the order in which the settings name them.

    Raises:
        VolumeError: a seed lies outside the volume or where nothing grows from it, or nothing is
            left of a structure.
    """
    labels = np.zeros(volume.shape, np.uint8)
    names = dict(enumerate(settings.structures, start=1))
    remarks: list[str] = []
    for number, name in names.items():
        progress((number - 1) / len(names), name)
        try:
            mask, box = _found(volume, settings.structures[name])
        except (VolumeError, RuntimeError) as error:  # the second is SimpleITK's
            raise VolumeError(f"structures.{name}: {error}") from error
        there = labels[box]
        for other, both in zip(*np.unique(there[mask], return_counts=True), strict=True):
            if other:
                remarks.append(f"{both} voxels of {name} are in {names[int(other)]} and stay there")
        free = mask & (there == 0)
        if not free.any():
            raise VolumeError(
                f"structures.{name}: all of it is in structures that come before it: name it "
                f"before them, or leave it out"
            )
        there[free] = number
    progress(1.0, "")
    return LabelMap(labels, names, remarks=tuple(remarks))


def _found(volume: Volume, asked: StructureSeeds) -> tuple[NDArray[np.bool_], tuple[slice, ...]]:
    """Find where a structure is, (i, j, k) in a box of the volume, and that box."""
    spacing = np.linalg.norm(volume.index_to_patient[:3, :3], axis=0)
    seeds = _seeds(volume, asked)
    first, last = np.zeros(3, dtype=int), np.array(volume.shape)
    if asked.reach is not None:
        away = np.ceil(asked.reach / spacing).astype(int) + 1
        first = np.maximum(first, seeds.min(axis=0) - away)
        last = np.minimum(last, seeds.max(axis=0) + away + 1)
    box = tuple(slice(int(a), int(b)) for a, b in zip(first, last, strict=True))
    seeds -= first
    grey = volume.intensities[box].astype(np.float32)
    if asked.smooth:
        grey = ndimage.gaussian_filter(grey, asked.smooth / spacing, truncate=3.0)
    for number, value in enumerate(grey[tuple(seeds.T)], start=1):
        if not asked.lower <= value <= asked.upper:
            raise VolumeError(
                f"seed {number} has the grey value {value:.0f}, outside {asked.lower:g} to "
                f"{asked.upper:g}, so nothing grows from it: move it, or widen the range"
            )
    found = SimpleITK.ConnectedThreshold(
        _image(grey, spacing), seeds.tolist(), asked.lower, asked.upper
    )
    if asked.reach is not None:
        near = np.ones(grey.shape, np.uint8)
        near[tuple(seeds.T)] = 0
        distance = ndimage.distance_transform_edt(near, sampling=spacing)
        found &= _image((distance <= asked.reach).astype(np.uint8), spacing)
    # The radius of a ball along each axis, in voxels.
    opening, closing = (np.rint(r / spacing).astype(int) for r in (asked.open, asked.close))
    found = SimpleITK.BinaryMorphologicalOpening(found, opening.tolist(), SimpleITK.sitkBall)
    found = SimpleITK.BinaryMorphologicalClosing(found, closing.tolist(), SimpleITK.sitkBall)
    mask = (
        SimpleITK.GetArrayFromImage(SimpleITK.BinaryFillhole(found)).transpose(2, 1, 0).astype(bool)
    )
    parts, _ = ndimage.label(mask, np.ones((3, 3, 3)))
    mask = np.isin(parts, np.setdiff1d(parts[tuple(seeds.T)], 0))
    if not mask.any():
        raise VolumeError("nothing is left of it: widen its range, or open it less")
    return mask, box


def _image(array: NDArray[np.generic], spacing: NDArray[np.float64]) -> SimpleITK.Image:
    """Make an image of an array (i, j, k) with that spacing (3,) in m; an image's is in mm."""
    image = SimpleITK.GetImageFromArray(np.ascontiguousarray(array.transpose(2, 1, 0)))
    image.SetSpacing((spacing * 1e3).tolist())
    return image


def _seeds(volume: Volume, asked: StructureSeeds) -> NDArray[np.int64]:
    """Find the voxels (N, 3) that a structure's seeds lie in; refuse seeds outside the volume."""
    matrix = volume.patient_to_index
    points = 1e-3 * np.array(asked.seeds_mm)
    seeds = np.floor(points @ matrix[:3, :3].T + matrix[:3, 3] + 0.5).astype(np.int64)
    outside = ((seeds < 0) | (seeds >= volume.shape)).any(axis=1)
    if outside.any():
        n = int(outside.argmax())
        low, high = volume.extent * 1e3
        spans = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in zip(low, high, strict=True))
        raise VolumeError(
            f"seeds_mm[{n}]: {list(asked.seeds_mm[n])} mm is outside the volume of "
            f"{' × '.join(map(str, volume.shape))} voxels, which spans {spans} mm; points of a "
            f"program that shows right-anterior-superior axes have their first two signs turned"
        )
    return seeds
