"""Volume files into frame ``patient``: MetaImage, NRRD and NIfTI through SimpleITK, and DICOM.

>>> import tempfile, SimpleITK
>>> from us_sim.volume.files.readers import read_volume
>>> image = SimpleITK.Image([30, 20, 10], SimpleITK.sitkUInt8)
>>> image.SetSpacing([0.5, 0.5, 1.0]); image.SetOrigin([-7.0, 0.0, 3.0])  # mm
>>> with tempfile.TemporaryDirectory() as folder:
...     SimpleITK.WriteImage(image, f"{folder}/sweep.nrrd")
...     volume = read_volume(f"{folder}/sweep.nrrd")
>>> volume.shape, volume.index_to_patient[0].tolist()
((30, 20, 10), [0.0005, 0.0, 0.0, -0.007])
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.axis_order import fill_from_slices
from us_sim.volume.files.dicom.header import is_dicom
from us_sim.volume.files.frame_sequence import holds_sequence
from us_sim.volume.files.placement import checked_placement
from us_sim.volume.files.stored_size import check_stored_size
from us_sim.volume.files.stored_voxels import check_claim
from us_sim.volume.volume import Volume

__all__ = ["open_image", "read_placement", "read_volume", "stored_voxels_of"]

# Not what else SimpleITK reads: a damaged DICOM file ends the process in which it reads one.
_READERS = {
    "mha": "MetaImageIO",
    "mhd": "MetaImageIO",
    "nrrd": "NrrdImageIO",
    "nhdr": "NrrdImageIO",
    "nii": "NiftiImageIO",
}


_SLAB = 1 << 23  # bytes that are turned at a time


def read_volume(path: str | os.PathLike[str]) -> Volume:
    """A scalar three-dimensional image file as a volume without labels.

    Frame ``patient`` is the file's own: DICOM's left-posterior-superior axes, in metres. Spacing,
    origin and direction matrix are all respected. uint8 is taken as it is; every other type is
    mapped linearly so that its smallest finite value becomes 0 and its largest 255 (a constant
    image becomes 0, and so does NaN, which some programs write where nothing was scanned).

    DICOM needs the extra ``dicom``: an Enhanced US Volume, or another file of several images that
    states where they lie; of several volumes in time the first is taken. Colour becomes grey. The
    axes are those that the file states: for an Enhanced US Volume its own frame of reference.

    Raises:
        VolumeError: the file is missing or no image, holds fewer or more bytes than its header
            says, is larger than `LARGEST_VOLUME` or the free memory, is not a scalar
            three-dimensional image of two voxels or more along each axis, or has a spacing,
            origin or direction that places no volume.
    """
    path = Path(path)
    if _is_dicom(path):
        from us_sim.volume.files.dicom.placed_images import placed_images

        placed = placed_images([path])
        return Volume(placed.voxels(), placed.placement)
    header, index_to_patient = open_image(path)
    plain = _plain_voxels(path, header)
    if plain is not None:
        return Volume(plain, index_to_patient)
    image = stored_voxels_of(path, header)
    stored = sitk.GetArrayViewFromImage(image)  # (k, j, i)
    return Volume(_grey_values(path, stored), index_to_patient)


def read_placement(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Where a volume file's voxels are: (4, 4) from their indices to m, from its header alone.

    Raises:
        VolumeError: as `read_volume`, except for faults of the voxels.
    """
    path = Path(path)
    if _is_dicom(path):
        from us_sim.volume.files.dicom.placed_images import placed_images

        return placed_images([path]).placement
    return open_image(path)[1]


def _plain_voxels(path: Path, header: sitk.ImageFileReader) -> NDArray[np.uint8] | None:
    """The voxels (i, j, k) of a file that holds them as they are, without a second copy of them."""
    stored = check_stored_size(path)
    if stored.packed or header.GetPixelID() != sitk.sitkUInt8:
        return None
    i, j, k = header.GetSize()
    voxels = np.empty((i, j, k), np.uint8)
    slab = max(1, _SLAB // (i * j))
    with stored.file.open("rb") as file:
        file.seek(stored.start + stored.skip)
        for first in range(0, k, slab):
            count = min(slab, k - first)
            data = np.fromfile(file, np.uint8, i * j * count)
            if data.size != i * j * count:
                raise VolumeError(f"{path}: became shorter while it was read; try again")
            fill_from_slices(voxels, first, data.reshape(count, j, i))
    return voxels


def _is_dicom(path: Path) -> bool:
    """Whether it is a DICOM file; one with another format's name is taken for what it says."""
    ending = path.name.lower().removesuffix(".gz").rpartition(".")[2]
    return ending not in _READERS and path.is_file() and is_dicom(path)


def stored_voxels_of(path: Path, header: sitk.ImageFileReader) -> sitk.Image:
    """The image of a file that `open_image` has opened.

    Raises:
        VolumeError: its data cannot be read.
    """
    try:
        return header.Execute()
    except RuntimeError as error:
        raise VolumeError(
            f"{path}: its image data cannot be read, as it is damaged, incomplete or too large for "
            f"this machine's memory; copy or export it again"
        ) from error


def open_image(
    path: Path, *, layers: bool = False
) -> tuple[sitk.ImageFileReader, NDArray[np.float64]]:
    """The reader of a file, its header read, and the placement of its voxels, (4, 4) m.

    Args:
        path: of the file.
        layers: a voxel may have several numbers, as segmentations of 3D Slicer have.

    Raises:
        VolumeError: as `read_volume`, except for faults of the voxels.
    """
    if not os.path.exists(path):
        raise VolumeError(f"{path}: there is no such file")
    if not os.path.isfile(path):
        raise VolumeError(f"{path}: is not a file; give one MHA, NRRD, NIfTI or DICOM volume")
    if holds_sequence(path):
        raise VolumeError(
            f"{path}: is a sequence of tracked frames, not a volume; make one of it with "
            f"`us-sim reconstruct {path.name} --out volume.nrrd`"
        )
    stored = check_stored_size(path)
    header = sitk.ImageFileReader()
    header.SetImageIO(_READERS[path.name.lower().removesuffix(".gz").rpartition(".")[2]])
    header.SetFileName(str(path))
    try:
        header.ReadImageInformation()
    except RuntimeError as error:
        raise VolumeError(
            f"{path}: cannot be read as an image; give an MHA, NRRD, NIfTI or DICOM volume"
        ) from error
    placement = _placement(path, header, layers=layers)
    value = int(re.findall(r"\d+", sitk.GetPixelIDValueAsString(header.GetPixelID()))[0]) // 8
    numbers = math.prod(header.GetSize()) * header.GetNumberOfComponents()
    if _is_scaled(path, header) and stored.expected == numbers * stored.value:
        check_claim(path, stored.size, value)
    elif stored.expected != numbers * value:
        raise VolumeError(
            f"{path}: its header says more than one thing about its size; export it again"
        )
    return header, placement


def _is_scaled(path: Path, header: sitk.ImageFileReader) -> bool:
    """Whether a NIfTI file stores whole numbers for others: ITK makes them floating-point ones.

    Its ``scl_slope`` is then neither 0 nor 1, or its ``scl_inter`` not 0.
    """
    floating = header.GetPixelID() in (sitk.sitkFloat32, sitk.sitkFloat64)
    return floating and path.name.lower().endswith((".nii", ".nii.gz"))


def _placement(path: Path, header: sitk.ImageFileReader, *, layers: bool) -> NDArray[np.float64]:
    """(4, 4) m, from the header alone, so that nothing unusable is read."""
    dimension, size = header.GetDimension(), header.GetSize()
    if dimension != 3:
        raise VolumeError(f"{path}: is {dimension}-dimensional; a volume has three dimensions")
    if min(size) < 2:
        raise VolumeError(
            f"{path}: has {' × '.join(map(str, size))} voxels; a volume needs two or more along "
            f"each axis"
        )
    pixel = sitk.GetPixelIDValueAsString(header.GetPixelID())
    if (header.GetNumberOfComponents() != 1 and not layers) or "complex" in pixel:
        raise VolumeError(
            f"{path}: holds {header.GetNumberOfComponents()} numbers per voxel ({pixel}); "
            f"convert it to one grey value"
        )
    direction = header.GetDirection()
    return checked_placement(path, header.GetSpacing(), direction, header.GetOrigin())


def _grey_values(path: Path, stored: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Stored values (k, j, i) of any scalar type as (i, j, k) uint8."""
    grey = np.empty(stored.shape[::-1], dtype=np.uint8)
    if stored.dtype == np.uint8:
        fill_from_slices(grey, 0, np.asarray(stored, np.uint8))
        return grey
    ranges = [_finite_range(plane) for plane in stored]
    low = min(lower for lower, _ in ranges)
    high = max(upper for _, upper in ranges)
    if low > high:
        raise VolumeError(f"{path}: holds no finite value")
    # Plane by plane: a whole volume in float64 would take eight times the memory of the file's.
    for k, plane in enumerate(stored):
        # Halves, since the whole range of a float64 image may exceed what float64 can hold.
        height = plane.astype(np.float64) / 2 - low / 2
        level = height / (high / 2 - low / 2) if high > low else np.zeros_like(height)
        level = np.clip(np.nan_to_num(level, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
        grey[:, :, k] = np.floor(level * 255.0 + 0.5).T
    return grey


def _finite_range(plane: NDArray[np.generic]) -> tuple[float, float]:
    values = plane.astype(np.float64)
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (np.inf, -np.inf)
