"""Structures of a volume, each found as its seeds say, put together into labels."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.settings.registry import SEGMENTATIONS
from us_sim.volume.files.stored_image import free_memory
from us_sim.volume.segmentation.region import (
    Index,
    Region,
    array_of,
    ball_closed,
    ball_opened,
    largest_part,
    parts_at_least,
    parts_with,
)
from us_sim.volume.segmentation.settings import SegmentationSettings, StructureSeeds
from us_sim.volume.volume import LabelMap, Volume

Progress = Callable[[float, str], None]


def segment(
    volume: Volume, settings: SegmentationSettings, progress: Progress = lambda *_: None
) -> LabelMap:
    """The labels of structures, numbered in the order in which the settings name them.

    Raises:
        VolumeError: a seed lies outside the volume or where nothing grows from it, nothing is left
            of a structure, or its region takes more memory than is free.
    """
    labels = np.zeros(volume.shape, np.uint8)
    names = dict(enumerate(settings.structures, start=1))
    order = sorted(names, key=lambda number: -settings.structures[names[number]].priority)
    remarks: list[str] = []
    for done, number in enumerate(order):
        name = names[number]

        def tell(part: float, work: str, done: int = done, name: str = name) -> None:
            progress((done + part) / len(order), f"{name}: {work}" if work else name)

        tell(0.0, "")
        mask, box = _found(volume, name, settings, tell)
        there = labels[box]
        for other, both in zip(*np.unique(there[mask], return_counts=True), strict=True):
            if other:
                remarks.append(f"{both} voxels of {name} are in {names[int(other)]} and stay there")
        free = mask & (there == 0)
        if not free.any():
            raise VolumeError(
                f"structures.{name}: all of it is in structures that come before it: give it a "
                f"higher priority, or leave it out"
            )
        there[free] = number
    progress(1.0, "")
    colours = {n: one.colour for n, one in enumerate(settings.structures.values(), 1) if one.colour}
    return LabelMap(labels, names, colours, tuple(remarks))


def _found(
    volume: Volume, name: str, settings: SegmentationSettings, progress: Progress
) -> tuple[NDArray[np.bool_], tuple[slice, ...]]:
    """Where a structure is, (i, j, k) in a box of the volume, and that box."""
    asked = settings.structures[name]
    spacing = np.linalg.norm(volume.index_to_patient[:3, :3], axis=0)
    seeds = seeds_of(volume, name, asked)
    box = box_of(volume, name, asked, seeds, spacing)
    # Bytes: some images in single precision, and parts as numbers.
    needed = 40 * float(np.prod([span.stop - span.start for span in box]))
    if needed > (free := free_memory()):
        raise VolumeError(
            f"structures.{name}: takes {needed / 1e9:.1f} GB of memory where {free / 1e9:.1f} GB "
            f"are free: give it a `reach` or `within_mm`"
        )
    others = _indices(volume, name, "outside_mm", asked.outside_mm)
    for other, one in settings.structures.items():
        others += seeds_of(volume, other, one) if other != name else []
    grey = _smoothed(volume.intensities[box].astype(np.float32), asked, spacing)
    inside, beside = _moved(seeds, box), _moved(others, box)
    near = [
        at for at in beside if all(0 <= n < size for n, size in zip(at, grey.shape, strict=True))
    ]
    region = Region(grey, spacing, tuple(inside), tuple(near), name, progress)
    mask = asked.method.settings(SEGMENTATIONS).found_in(region)
    if asked.reach is not None:
        mask &= _near(inside, asked.reach, spacing, grey.shape)
    # The rest takes time and memory by the size of its part.
    part = _around(mask, max(asked.open, asked.close), spacing)
    region = replace(region, grey=grey[part], seeds=tuple(_moved(inside, part)))
    whole = tuple(
        slice(outer.start + inner.start, outer.start + inner.stop)
        for outer, inner in zip(box, part, strict=True)
    )
    return _finished(mask[part], asked, region), whole


def _moved(indices: Iterable[Index], box: tuple[slice, ...]) -> list[Index]:
    """Indices counted from the beginning of a box."""
    a, b, c = (span.start for span in box)
    return [(i - a, j - b, k - c) for i, j, k in indices]


def _around(
    mask: NDArray[np.bool_], margin: float, spacing: NDArray[np.float64]
) -> tuple[slice, ...]:
    """The box around a mask, wider by a margin (m) and a voxel; all where it is empty."""
    found = ndimage.find_objects(mask.view(np.uint8))
    if not found:
        return tuple(slice(0, size) for size in mask.shape)
    more = np.ceil(margin / spacing).astype(int) + 1
    return tuple(
        slice(max(0, span.start - int(by)), min(size, span.stop + int(by)))
        for span, by, size in zip(found[0], more, mask.shape, strict=True)
    )


def _finished(mask: NDArray[np.bool_], asked: StructureSeeds, region: Region) -> NDArray[np.bool_]:
    mask = ball_opened(mask, asked.open, region.spacing)
    mask = ball_closed(mask, asked.close, region.spacing)
    if asked.fill:
        mask = np.asarray(ndimage.binary_fill_holes(mask))
    mask = parts_at_least(mask, asked.smallest_mm3 * 1e-9 / float(np.prod(region.spacing)))
    keep = asked.keep or ("seeded" if region.seeds else "all")
    if keep == "seeded":
        mask = parts_with(mask, region.seeds)
    elif keep == "largest":
        mask = largest_part(mask)
    if not mask.any():
        raise VolumeError(
            f"structures.{region.name}: nothing is left of it: widen its range, open it "
            f"less, or keep smaller parts"
        )
    return mask


def _smoothed(
    grey: NDArray[np.float32], asked: StructureSeeds, spacing: NDArray[np.float64]
) -> NDArray[np.float32]:
    if asked.smooth <= 0.0:
        return grey
    steps = asked.smooth / spacing
    if asked.smoothing == "gaussian":
        return np.asarray(ndimage.gaussian_filter(grey, steps, truncate=3.0))
    image = sitk.GetImageFromArray(np.ascontiguousarray(grey.transpose(2, 1, 0)))
    if asked.smoothing == "median":
        smooth = sitk.Median(image, np.maximum(1, np.rint(steps)).astype(int).tolist())
        return array_of(smooth).astype(np.float32)
    # Diffusion for a time t smooths as a Gaussian of √(2 t) does, in voxels, away from edges.
    time = float(np.mean(steps) ** 2) / 2.0
    rounds = max(5, int(np.ceil(time / 0.0625)))
    smooth = sitk.CurvatureAnisotropicDiffusion(image, time / rounds, 3.0, 1, rounds)
    return array_of(smooth).astype(np.float32)


def _near(
    seeds: list[Index], reach: float, spacing: NDArray[np.float64], shape: tuple[int, ...]
) -> NDArray[np.bool_]:
    """(i, j, k) whether a voxel is within reach of a seed."""
    near = np.zeros(shape, bool)
    grid = np.ogrid[tuple(slice(0, size) for size in shape)]
    for seed in seeds:
        away = sum(((n - at) * side) ** 2 for n, at, side in zip(grid, seed, spacing, strict=True))
        near |= away <= reach**2
    return near


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


def _indices(
    volume: Volume, name: str, key: str, points: tuple[tuple[float, float, float], ...]
) -> list[Index]:
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
