"""Which images of DICOM files make a volume, in which order, and where they lie."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import numbers, open_dicom, text
from us_sim.volume.files.dicom.pixels import GreyImages
from us_sim.volume.files.dicom.planes import (
    EXPORT,
    Plane,
    grid_of,
    image_kinds,
    image_times,
    stated_planes,
)
from us_sim.volume.files.stored_image import volume_of_slices

SEGMENTATIONS = ("1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.66.7")
"""Classes of files that hold labels: masks of segments, and label maps."""


@dataclass(frozen=True, eq=False)
class PlacedImages:
    """The images of one volume, ordered along their normal."""

    images: GreyImages
    which: list[tuple[int, int]]  # of which file, and which of its images
    placement: NDArray[np.float64]  # (4, 4) m, from (column, row, image)
    volumes: int  # how many there are in time

    def voxels(self) -> NDArray[np.uint8]:
        """Read the grey values (i, j, k), a few images at a time."""
        return volume_of_slices(self.images.images(self.which), len(self.which))


def opened_images(paths: Sequence[str | os.PathLike[str]]) -> GreyImages:
    """Open the images of one or several DICOM files."""
    files = [open_dicom(path) for path in paths]
    for file in files:
        if text(file.header, "SOPClassUID") in SEGMENTATIONS:
            raise VolumeError(
                f"{file.path}: is a segmentation, which has labels and no grey values; save it as "
                f".seg.nrrd in 3D Slicer, and give that to `us-sim segment CASE --labels`"
            )
    return GreyImages(files)


def is_flat(images: GreyImages, spacing: Sequence[float] = ()) -> bool:
    """Whether the images are no volume: nothing says where they lie, or all lie at one place."""
    return len({plane.position for plane in _planes(images, spacing)[0]}) < 2


def placed_images(
    images: GreyImages,
    volume: int = 1,
    spacing: Sequence[float] = (),
) -> PlacedImages:
    """Place the volume that DICOM files hold: an enhanced or multi-frame one, or an image each.

    Args:
        images: of the files, in any order.
        volume: which one where there are several in time, the first of which is 1.
        spacing: mm, width and height of pixels and distance of images, of files that state where
            their images lie, but not the size of pixels; or empty.

    Raises:
        VolumeError: the files hold no volume, or one that only its maker can read; or they do not
            belong together.
    """
    path = images.files[0].path
    for key in ("SeriesInstanceUID", "FrameOfReferenceUID"):
        if len({text(file.header, key) for file in images.files}) > 1:
            raise VolumeError(
                f"{path}: and the other files are of several series; give the files of one"
            )
    planes, times = _planes(images, spacing)
    if len({plane.position for plane in planes}) < 2:
        raise VolumeError(f"{path}: {_why_flat(images, planes)}")
    kinds: list[str] = []
    for file, form in zip(images.files, images.formats, strict=True):
        kinds += image_kinds(file, form.frames)
    kind = "TISSUE_INTENSITY" if "TISSUE_INTENSITY" in kinds else kinds[0]
    wanted = images.all
    at_time: dict[float, list[int]] = {}
    for n in (n for n in range(len(wanted)) if kinds[n] == kind):
        at_time.setdefault(times[n], []).append(n)
    groups = [at_time[time] for time in sorted(at_time)]
    if not 1 <= volume <= len(groups):
        raise VolumeError(
            f"{path}: holds {len(groups)} volumes in time; number {volume} is none of them"
        )
    chosen = groups[volume - 1]
    shape = images.form.columns, images.form.rows, len(chosen)
    if min(shape) < 2:
        raise VolumeError(
            f"{path}: has {' × '.join(map(str, shape))} voxels; a volume needs two or more along "
            f"each axis"
        )
    if len({planes[n].position for n in chosen}) < len(chosen):
        raise VolumeError(
            f"{path}: several of its images are at the same place; give the files of one volume"
        )
    slices, placement = grid_of(path, [planes[n] for n in chosen])
    steps = np.linalg.norm(placement[:3, :3], axis=0) * 1e3
    if spacing and not np.allclose(spacing, steps[: len(spacing)], rtol=0.02):
        shown = ",".join(f"{step:.5g}" for step in steps)
        raise VolumeError(f"{path}: its voxels are {shown} mm apart: leave out --spacing")
    which = [wanted[chosen[n]] for n in np.argsort(slices)]
    return PlacedImages(images, which, placement, len(groups))


def _planes(images: GreyImages, spacing: Sequence[float]) -> tuple[list[Plane], list[float]]:
    """Return the place and time of every image; none where a file does not state them."""
    planes: list[Plane] = []
    times: list[float] = []
    for file, form in zip(images.files, images.formats, strict=True):
        own = stated_planes(file, form.frames, spacing)
        if own is None:
            return [], []
        planes += own
        times += image_times(file, form.frames)
    return planes, times


def _why_flat(images: GreyImages, planes: Sequence[Plane]) -> str:
    """Say what the files are that hold no volume, with advice."""
    first, count = images.files[0], len(images.all)
    as_images = f"import it as 2D images: `us-sim import {first.path.name} --out images.igs.mha`"
    if len(planes) == 1:
        return "is one slice of a volume; put the files of its series into one folder, and name it"
    if planes:
        return f"holds {count} images at one place, one after another in time; {as_images}"
    if numbers(first.header, "ImagePositionPatient", 3):
        return (
            "states where its images lie, but not the size of pixels: say it with `us-sim import "
            "--spacing X,Y,Z` (mm)"
        )
    kind = "a 2D image" if count == 1 else f"2D, with {count} images"
    return f"is {kind}, not a volume: nothing says where its images lie; {as_images}; {EXPORT}"
