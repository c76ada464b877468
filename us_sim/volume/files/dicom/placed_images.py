"""Which images of DICOM files make a volume, in which order, and where they lie."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import number, numbers, open_dicom, text
from us_sim.volume.files.dicom.pixels import GreyImages
from us_sim.volume.files.dicom.planes import (
    Plane,
    grid_of,
    hidden_volume,
    image_kinds,
    image_times,
    one_image_after_another,
    stated_planes,
    vendor_planes,
)
from us_sim.volume.files.segments import no_grey_values
from us_sim.volume.files.stored_image import volume_of_slices

SEGMENTATIONS = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
"""Classes of files that hold labels: masks of segments, and label maps."""

_MOST_FILES = 1 << 14


@dataclass(frozen=True, eq=False)
class PlacedImages:
    """The images of one volume, ordered along their normal."""

    images: GreyImages
    which: list[tuple[int, int]]  # of which file, and which of its images
    placement: NDArray[np.float64]  # (4, 4) m, from (column, row, image)
    volumes: int  # how many there are in time

    def voxels(
        self,
        keep: NDArray[np.bool_] | None = None,
        progress: Callable[[float, str], None] | None = None,
    ) -> NDArray[np.uint8]:
        """The grey values (i, j, k), read a few images at a time.

        Args:
            keep: (rows, columns) the pixels of each image that are kept; the rest becomes 0.
            progress: told the fraction that is read.

        Raises:
            VolumeError: an image is damaged, or its decoder is missing.
        """
        return volume_of_slices(self.images.images(self.which, keep), len(self.which), progress)


def opened_images(paths: Sequence[str | os.PathLike[str]]) -> GreyImages:
    """The images of one or several DICOM files.

    Raises:
        VolumeError: as `open_dicom` and `GreyImages`.
    """
    if len(paths) > _MOST_FILES:
        raise VolumeError(f"{len(paths)} files are more than the {_MOST_FILES} that are read")
    files = [one_image_after_another(open_dicom(path)) for path in paths]
    for file in files:
        if text(file.header, "SOPClassUID") in SEGMENTATIONS:
            raise no_grey_values(file.path)
    # A maker's own volume may have a picture of no use beside it, or none at all.
    for file in files:
        if file.pixels is None and (remedy := hidden_volume(file)):
            raise VolumeError(f"{file.path}: holds no image, but {remedy}")
    return GreyImages(files)


def is_flat(images: GreyImages, spacing: Sequence[float] = ()) -> bool:
    """Whether the images are no volume: nothing says where they lie, or all lie at one place."""
    planes, _ = _planes(images, spacing)
    return planes is None or len({plane.position for plane in planes}) < 2


def placed_images(
    paths: Sequence[str | os.PathLike[str]] | GreyImages,
    volume: int = 1,
    spacing: Sequence[float] = (),
) -> PlacedImages:
    """The volume that DICOM files hold: an enhanced or multi-frame one, or an image each.

    Args:
        paths: of the files, in any order; or their images.
        volume: which one where there are several in time, the first of which is 1.
        spacing: mm, width and height of pixels and distance of images, of files that state where
            their images lie, but not the size of pixels; or empty.

    Raises:
        VolumeError: the files hold no volume, or one that only its maker can read; or they do not
            belong together.
    """
    images = paths if isinstance(paths, GreyImages) else opened_images(paths)
    path = images.files[0].path
    for key in ("SeriesInstanceUID", "FrameOfReferenceUID"):
        if len({text(file.header, key) for file in images.files}) > 1:
            raise VolumeError(
                f"{path}: and the other files are of several series; give the files of one"
            )
    planes, times = _planes(images, spacing)
    if planes is None or len({plane.position for plane in planes}) < 2:
        raise VolumeError(f"{path}: {_why_flat(images, planes)}")
    kinds: list[str] = []
    for file, form in zip(images.files, images.formats, strict=True):
        kinds += image_kinds(file, form.frames)
    kind = "TISSUE_INTENSITY" if "TISSUE_INTENSITY" in kinds else kinds[0]
    wanted = images.all
    here = [n for n in range(len(wanted)) if kinds[n] == kind]
    groups = _in_time(path, here, planes, times)
    if not 1 <= volume <= len(groups):
        raise VolumeError(
            f"{path}: holds {len(groups)} volumes in time; number {volume} is none of them"
        )
    chosen = groups[volume - 1]
    order, placement = grid_of(path, [planes[n] for n in chosen])
    _check_spacing(path, spacing, placement)
    shape = images.form.columns, images.form.rows, len(chosen)
    if min(shape) < 2:
        raise VolumeError(
            f"{path}: has {' × '.join(map(str, shape))} voxels; a volume needs two or more along "
            f"each axis"
        )
    return PlacedImages(images, [wanted[chosen[n]] for n in order], placement, len(groups))


def _planes(images: GreyImages, spacing: Sequence[float]) -> tuple[list[Plane] | None, list[float]]:
    """The place and time of every image; None where a file does not state them."""
    planes: list[Plane] = []
    times: list[float] = []
    for file, form in zip(images.files, images.formats, strict=True):
        found = vendor_planes(file, form.frames)
        own = found[0] if found else stated_planes(file, form.frames, spacing)
        if own is None:
            return None, []
        planes += own
        times += found[1] if found else image_times(file, form.frames)
    return planes, times


def _check_spacing(path: Path, spacing: Sequence[float], placement: NDArray[np.float64]) -> None:
    """Refuse a person's spacing that is not that of the files.

    Raises:
        VolumeError: it is not.
    """
    steps = np.linalg.norm(placement[:3, :3], axis=0) * 1e3
    shown = ",".join(f"{step:.5g}" for step in steps)
    for given, step in zip(spacing, steps, strict=False):
        if abs(given - step) > 0.02 * step:
            raise VolumeError(f"{path}: its voxels are {shown} mm apart: leave out --spacing")


def _in_time(
    path: Path, here: Sequence[int], planes: Sequence[Plane], times: Sequence[float]
) -> list[list[int]]:
    """The images of each volume, by their times, or where these are alike as they follow."""
    at_time: dict[float, list[int]] = {}
    for n in here:
        at_time.setdefault(times[n], []).append(n)
    if len(at_time) > 1:
        return [at_time[time] for time in sorted(at_time)]
    places = Counter(planes[n].position for n in here)
    count = max(places.values())
    if set(places.values()) != {count}:
        raise VolumeError(
            f"{path}: several of its images are at the same place, but not at every place as many; "
            f"give the files of one volume"
        )
    made: list[list[int]] = [[] for _ in range(count)]
    seen: Counter[tuple[float, ...]] = Counter()
    for n in here:
        made[seen[planes[n].position]].append(n)
        seen[planes[n].position] += 1
    return made


def _why_flat(images: GreyImages, planes: Sequence[Plane] | None) -> str:
    """The kind of files that hold no volume, and advice."""
    count = len(images.all)
    as_images = f"`us-sim import {images.files[0].path.name} --out images.igs.mha`"
    if planes and count == 1:
        return (
            "is one slice of a volume; put the files of its series into one folder, and name that"
        )
    if planes:
        return (
            f"holds {count} images at one place, one after another in time, and no volume; as 2D "
            f"images it is imported with {as_images}"
        )
    kind = "a 2D image" if count == 1 else f"a 2D cine of {count} images"
    if len(images.files) > 1:
        kind = f"one of {len(images.files)} files with 2D images"
    if numbers(images.files[0].header, "ImagePositionPatient", 3):
        return (
            f"states where {'its image lies' if count == 1 else 'its images lie'}, but not the "
            f"size of pixels: say it with `us-sim import --spacing X,Y,Z` (mm)"
        )
    timed = number(images.files[0].header, "FrameTime")
    kind += ", one after another in time" if timed and count > 1 else ""
    remedy = next(filter(None, map(hidden_volume, images.files)), "") or (
        f"export the 3D data as an Enhanced US Volume, or record a tracked sweep and reconstruct "
        f"it; as 2D images it is imported with {as_images}"
    )
    return f"is {kind}, not a volume: nothing in it says where its images lie in space; {remedy}"
