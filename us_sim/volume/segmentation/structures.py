"""Structures of a volume, each found as its seeds say, put together into labels."""

from __future__ import annotations

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.volume.segmentation.methods import (
    Index,
    Progress,
    array_of,
    dark_vessels,
    grow,
    image_of,
    in_voxels,
)
from us_sim.volume.segmentation.settings import SegmentationSettings, StructureSeeds
from us_sim.volume.volume import LabelMap, Volume


def segment(
    volume: Volume, settings: SegmentationSettings, progress: Progress = lambda *_: None
) -> LabelMap:
    """The labels of structures, numbered in the order in which the settings name them.

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
    colours = {n: one.colour for n, one in enumerate(settings.structures.values(), 1) if one.colour}
    return LabelMap(labels, names, colours, tuple(remarks))


def find_vessels(volume: Volume, progress: Progress = lambda *_: None) -> LabelMap:
    """Propose dark vessels, as one structure.

    Raises:
        VolumeError: there are none.
    """
    spacing = np.linalg.norm(volume.index_to_patient[:3, :3], axis=0)
    found = dark_vessels(image_of(volume.intensities.astype(np.float32), spacing), progress)
    labels = array_of(sitk.BinaryFillhole(found)).astype(np.uint8)
    if not labels.any():
        raise VolumeError("no dark vessels are found: give --seeds, or --labels")
    return LabelMap(labels, {1: "vessels"})


def _found(volume: Volume, asked: StructureSeeds) -> tuple[NDArray[np.bool_], tuple[slice, ...]]:
    """Where a structure is, (i, j, k) in a box of the volume, and that box."""
    spacing = np.linalg.norm(volume.index_to_patient[:3, :3], axis=0)
    seeds = np.array(_seeds(volume, asked), dtype=int).reshape(-1, 3)
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
    placed: list[Index] = [(int(i), int(j), int(k)) for i, j, k in seeds]
    found = grow(image_of(grey, spacing), placed, asked.lower, asked.upper)
    if asked.reach is not None:
        near = np.ones(grey.shape, np.uint8)
        near[tuple(seeds.T)] = 0
        distance = ndimage.distance_transform_edt(near, sampling=spacing)
        found &= image_of((distance <= asked.reach).astype(np.uint8), spacing)
    found = sitk.BinaryMorphologicalOpening(found, in_voxels(asked.open, found), sitk.sitkBall)
    found = sitk.BinaryMorphologicalClosing(found, in_voxels(asked.close, found), sitk.sitkBall)
    mask = array_of(sitk.BinaryFillhole(found)).astype(bool)
    parts, _ = ndimage.label(mask, np.ones((3, 3, 3)))
    mask = np.isin(parts, np.setdiff1d(parts[tuple(seeds.T)], 0))
    if not mask.any():
        raise VolumeError("nothing is left of it: widen its range, or open it less")
    return mask, box


def _seeds(volume: Volume, asked: StructureSeeds) -> list[Index]:
    """Indices of the voxels that a structure's seeds lie in.

    Raises:
        VolumeError: one is outside the volume.
    """
    seeds = []
    for n, point in enumerate(asked.seeds_mm):
        at = volume.patient_to_index @ [*(1e-3 * np.array(point)), 1.0]
        i, j, k = (int(n) for n in np.floor(at[:3] + 0.5))
        if not all(0 <= n < size for n, size in zip((i, j, k), volume.shape, strict=True)):
            low, high = volume.extent * 1e3
            spans = ", ".join(f"{a:.0f} to {b:.0f}" for a, b in zip(low, high, strict=True))
            raise VolumeError(
                f"seeds_mm[{n}]: {list(point)} mm is outside the volume of "
                f"{' × '.join(map(str, volume.shape))} voxels, which spans {spans} mm; points of a "
                f"program that shows right-anterior-superior axes have their first two signs turned"
            )
        seeds.append((i, j, k))
    return seeds
