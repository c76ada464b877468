"""Volumes and labels into files: NRRD, MetaImage and NIfTI, through SimpleITK.

A file is written beside its place under another name and renamed, so it is whole or absent.

>>> import pathlib, tempfile
>>> import numpy as np
>>> from us_sim.volume.files.readers import read_volume
>>> from us_sim.volume.files.writing import write_volume
>>> from us_sim.volume.volume import Volume
>>> grid = np.diag([0.5e-3, 0.5e-3, 1e-3, 1.0])
>>> volume = Volume(np.arange(60, dtype=np.uint8).reshape(3, 4, 5), grid)
>>> with tempfile.TemporaryDirectory() as folder:
...     write_volume(pathlib.Path(folder, "volume.nrrd"), volume)
...     again = read_volume(pathlib.Path(folder, "volume.nrrd"))
>>> bool((again.intensities == volume.intensities).all()), again.index_to_patient[2].tolist()
(True, [0.0, 0.0, 0.001, 0.0])
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.anatomical_colours import Colour, anatomical_colour
from us_sim.volume.files.axis_order import file_order
from us_sim.volume.files.plain_writing import (
    check_fields,
    grid_in_mm,
    partial_file,
    write_plain,
)
from us_sim.volume.volume import Volume

_ENDINGS = (".seg.nrrd", ".nrrd", ".mha", ".nii.gz", ".nii")
_SLAB = 1 << 24  # voxels that are turned at a time
_FASTEST = 1  # zlib's level; speckle hardly becomes smaller with any other


def write_volume(
    path: str | os.PathLike[str], volume: Volume, header: Mapping[str, str] | None = None
) -> None:
    """The grey values of a volume as an image file; a file of that name is replaced.

    Spacing, origin and direction are those of ``index_to_patient`` in millimetres, on DICOM's
    left-posterior-superior axes. NRRD and MetaImage hold them to 17 digits; NIfTI to 7.

    Args:
        path: ends in .nrrd, .mha, .nii or .nii.gz.
        volume: its labels are not written here; see `write_labels`.
        header: further fields for the file's header. NIfTI has no place for them.

    Raises:
        VolumeError: the name ends otherwise, the grid has no right angles, a field cannot stand
            in a header, or the file cannot be written.
    """
    path = Path(path)
    if path.name.lower().endswith(".seg.nrrd"):
        raise VolumeError(f"{path}: .seg.nrrd is for labels; name the volume .nrrd")
    fields = dict(header or {})
    if path.name.lower().endswith((".nrrd", ".mha")):
        write_plain(path, volume.intensities, volume.index_to_patient, fields)
        return
    _write(path, _image(path, volume.intensities, volume), fields, packed=False)


def write_labels(
    path: str | os.PathLike[str], volume: Volume, colours: Mapping[int, Colour] | None = None
) -> None:
    """The labels of a volume as an image file, compressed; a file of that name is replaced.

    NRRD files hold each label's name and colour as segmentations of 3D Slicer do
    (slicer.readthedocs.io, "Segmentation labelmap file format"), which opens one as such where the
    name ends in .seg.nrrd; label 0 is no segment there. In other files there are numbers only.

    Args:
        path: ends in .seg.nrrd, .nrrd, .mha, .nii or .nii.gz.
        volume: with labels; a label without a name is called by its number.
        colours: red, green and blue from 0 to 1 by label; `anatomical_colour` where not given.

    Raises:
        VolumeError: as `write_volume`, or the volume has no labels.
    """
    path = Path(path)
    if volume.labels is None:
        raise VolumeError(f"{path}: the volume has no labels to write: segment it")
    fields = {}
    if path.name.lower().endswith(".nrrd"):
        fields = _segments(volume.labels, volume.label_names, dict(colours or {}))
    _write(path, _image(path, volume.labels, volume), fields, packed=True)


def _segments(
    labels: NDArray[np.uint8], names: Mapping[int, str], colours: Mapping[int, Colour]
) -> dict[str, str]:
    """The fields by which 3D Slicer knows the segments of a label image (i, j, k)."""
    there = np.flatnonzero(np.bincount(labels.reshape(-1), minlength=256))
    wanted = sorted({*(int(label) for label in there), *names} - {0})
    extent = " ".join(f"0 {count - 1}" for count in labels.shape)
    fields = {
        "Segmentation_MasterRepresentation": "Binary labelmap",
        "Segmentation_ContainedRepresentationNames": "Binary labelmap|",
        "Segmentation_ReferenceImageExtentOffset": "0 0 0",
    }
    for number, label in enumerate(wanted):
        name = names.get(label, f"label {label}")
        colour = colours.get(label) or anatomical_colour(name)
        fields |= {
            f"Segment{number}_ID": f"Segment_{label}",
            f"Segment{number}_Name": name,
            f"Segment{number}_Color": " ".join(f"{part:.6g}" for part in colour),
            f"Segment{number}_LabelValue": str(label),
            f"Segment{number}_Layer": "0",
            f"Segment{number}_Extent": extent,
            f"Segment{number}_NameAutoGenerated": "0",
            f"Segment{number}_ColorAutoGenerated": "0",
        }
    return fields


def _image(path: Path, voxels: NDArray[np.uint8], volume: Volume) -> sitk.Image:
    """The voxels (i, j, k) where the volume places them; a slab is turned at a time."""
    spacing, direction, origin = grid_in_mm(path, voxels.shape, volume.index_to_patient)
    image = sitk.Image(list(voxels.shape), sitk.sitkUInt8)
    step = max(1, _SLAB // (voxels.shape[0] * voxels.shape[1]))
    for k in range(0, voxels.shape[2], step):
        slab = sitk.GetImageFromArray(file_order(voxels[:, :, k : k + step]))
        image[:, :, k : k + step] = slab
    image.SetSpacing(spacing.tolist())
    image.SetOrigin(origin.tolist())
    image.SetDirection(direction.ravel().tolist())
    return image


def _write(path: Path, image: sitk.Image, fields: Mapping[str, str], *, packed: bool) -> None:
    ending = next((end for end in _ENDINGS if path.name.lower().endswith(end)), None)
    if ending is None:
        raise VolumeError(f"{path}: its name must end in {', '.join(_ENDINGS)}")
    check_fields(path, fields)
    for key, value in fields.items():
        image.SetMetaData(key, value)
    with partial_file(path, f"image{ending}") as partial:
        try:
            sitk.WriteImage(image, str(partial), packed, _FASTEST)
        except RuntimeError as error:
            raise VolumeError(f"{path}: cannot be written: the disk may be full") from error
