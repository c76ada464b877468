"""Volumes, labels and image sequences into files: NRRD, MetaImage and NIfTI.

A file is written beside its place under another name and renamed, so it is whole or absent.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import degrees_off, is_right_angled
from us_sim.volume.partial_file import partial_file
from us_sim.volume.structure_names import Colour, anatomical_colour
from us_sim.volume.volume import Volume

VOLUME_ENDINGS = (".nrrd", ".mha", ".nii.gz", ".nii")
"""Of the names of files that volumes are written to."""

_LEVEL = 1  # of compression: speckle hardly becomes smaller with any other


def write_volume(path: str | os.PathLike[str], volume: Volume) -> None:
    """Write the grey values of a volume; a file of that name is replaced.

    Spacing, origin and direction are those of ``index_to_patient`` in millimetres, on DICOM's
    left-posterior-superior axes. NRRD and MetaImage hold them to 17 digits; NIfTI to 7.

    Args:
        path: ends in .nrrd, .mha, .nii or .nii.gz.
        volume: its labels are not written here; see `write_labels`.

    Raises:
        VolumeError: the name ends otherwise, the grid has no right angles, or the file cannot be
            written.
    """
    path = Path(path)
    if path.name.lower().endswith(".seg.nrrd"):
        raise VolumeError(f"{path}: .seg.nrrd is for labels; name the volume .nrrd")
    _write_image(path, volume.intensities, volume, {}, packed=False)


def write_labels(
    path: str | os.PathLike[str], volume: Volume, colours: Mapping[int, Colour] | None = None
) -> None:
    """Write the labels of a volume, compressed; a file of that name is replaced.

    NRRD files hold each label's name and colour as segmentations of 3D Slicer do
    (slicer.readthedocs.io, "Segmentation labelmap file format"), which opens one as such where the
    name ends in .seg.nrrd; label 0 is no segment there. In other files there are numbers only.

    Args:
        path: ends in .seg.nrrd, .nrrd, .mha, .nii or .nii.gz.
        volume: with labels; a label without a name is called by its number.
        colours: red, green and blue from 0 to 1 by label; `anatomical_colour` where not given.
    """
    path = Path(path)
    if volume.labels is None:
        raise VolumeError(f"{path}: the volume has no labels to write: segment it")
    fields = {}
    if path.name.lower().endswith(".nrrd"):
        fields = _segment_fields(volume.labels, volume.label_names, dict(colours or {}))
    _write_image(path, volume.labels, volume, fields, packed=True)


def write_image_sequence(
    path: Path,
    images: Iterable[NDArray[np.uint8]],
    shape: tuple[int, int, int],
    times: Sequence[float],
    pixel_mm: tuple[float, float] = (1.0, 1.0),
) -> None:
    """Write images and their times, without poses, as a MetaImage sequence of Plus.

    Args:
        path: ends in .mha.
        images: (rows, columns), in order.
        shape: number of images, rows, columns.
        times: s, of each image.
        pixel_mm: width and height of a pixel.

    Raises:
        VolumeError: the name ends otherwise, or the file cannot be written.
    """
    if not path.name.lower().endswith(".mha"):
        raise VolumeError(f"{path}: a sequence of images is written as .igs.mha or .mha")
    count, rows, columns = shape
    fields = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "DimSize": f"{columns} {rows} {count}",
        "ElementSpacing": f"{pixel_mm[0]:.9g} {pixel_mm[1]:.9g} 1",
        "ElementType": "MET_UCHAR",
        "Kinds": "domain domain list",
        "UltrasoundImageOrientation": "MFA",
        "UltrasoundImageType": "BRIGHTNESS",
    }
    for number, time in enumerate(times):
        fields[f"Seq_Frame{number:04}_ImageStatus"] = "OK"
        fields[f"Seq_Frame{number:04}_Timestamp"] = f"{time:.9g}"
    fields["ElementDataFile"] = "LOCAL"
    with partial_file(path, "image.mha") as partial, partial.open("wb") as file:
        file.write("".join(f"{key} = {value}\n" for key, value in fields.items()).encode("ascii"))
        for image in images:
            file.write(np.ascontiguousarray(image).tobytes())


def _segment_fields(
    labels: NDArray[np.uint8], names: Mapping[int, str], colours: Mapping[int, Colour]
) -> dict[str, str]:
    """Return the fields by which 3D Slicer knows the segments of a label image (i, j, k)."""
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


def _write_image(
    path: Path,
    voxels: NDArray[np.uint8],
    volume: Volume,
    fields: Mapping[str, str],
    *,
    packed: bool,
) -> None:
    """Write voxels (i, j, k) where the volume places them."""
    matrix = volume.index_to_patient * 1e3
    spacing = np.linalg.norm(matrix[:3, :3], axis=0)
    direction = matrix[:3, :3] / spacing
    if not is_right_angled(direction):
        raise VolumeError(
            f"{path}: the volume's axes are {degrees_off(direction):.2g}° off a right angle, which "
            f"image files cannot hold; resample it on a grid with right angles"
        )
    ending = next((end for end in VOLUME_ENDINGS if path.name.lower().endswith(end)), None)
    if ending is None:
        raise VolumeError(f"{path}: its name must end in {', '.join(VOLUME_ENDINGS)}")
    with partial_file(path, f"image{ending}") as partial:
        if ending.startswith(".nii"):  # ITK refuses axes that are rounded
            import nibabel  # which takes half a second

            affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ matrix
            affine[3] = (0.0, 0.0, 0.0, 1.0)
            nifti = nibabel.Nifti1Image(voxels, affine)  # type: ignore[attr-defined,no-untyped-call]
            nifti.header.set_xyzt_units("mm")
            nifti.to_filename(partial)
        else:
            image = sitk.GetImageFromArray(voxels.transpose(2, 1, 0))
            image.SetSpacing(spacing.tolist())
            image.SetOrigin(matrix[:3, 3].tolist())
            image.SetDirection(direction.ravel().tolist())
            for key, value in fields.items():
                image.SetMetaData(key, value)
            try:
                sitk.WriteImage(image, str(partial), packed, _LEVEL)
            except RuntimeError as error:
                raise VolumeError(f"{path}: cannot be written: the disk may be full") from error
