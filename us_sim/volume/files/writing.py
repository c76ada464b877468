"""Volumes, labels and image sequences into files: NRRD, MetaImage and NIfTI.

A file is written beside its place under another name and renamed, so it is whole or absent. Grey
values go into NRRD files a slab at a time: SimpleITK and nibabel, which write the others, have the
whole image a second time, turned to the files' order of axes.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import degrees_off, is_right_angled
from us_sim.volume.files.stored_image import file_order
from us_sim.volume.partial_file import partial_file
from us_sim.volume.structure_names import Colour, anatomical_colour
from us_sim.volume.volume import Volume

_ENDINGS = (".seg.nrrd", ".nrrd", ".mha", ".nii.gz", ".nii")
_SLAB = 1 << 23  # bytes


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
    fields, voxels = dict(header or {}), volume.intensities
    if not path.name.lower().endswith(".nrrd"):
        _write_image(path, voxels, volume, fields, packed=False)
        return
    head = _nrrd_header(path, volume, fields)
    with partial_file(path, "image.nrrd") as partial, partial.open("wb") as file:
        file.write(head.encode("utf-8"))
        step = max(1, _SLAB // (voxels.shape[0] * voxels.shape[1]))
        for k in range(0, voxels.shape[2], step):
            file.write(file_order(voxels[:, :, k : k + step]).data)


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
        fields = _segment_fields(volume.labels, volume.label_names, dict(colours or {}))
    _write_image(path, volume.labels, volume, fields, packed=True)


def write_image_sequence(
    path: Path,
    images: Iterable[NDArray[np.uint8]],
    shape: tuple[int, int, int],
    times: Sequence[float],
    pixel_mm: tuple[float, float] = (1.0, 1.0),
    header: Mapping[str, str] | None = None,
) -> None:
    """Images and their times as a new sequence file, without poses: a MetaImage as Plus writes it.

    Args:
        path: ends in .mha.
        images: (rows, columns), in order.
        shape: number of images, rows, columns.
        times: s, of each image.
        pixel_mm: width and height of a pixel.
        header: further fields of one line each.

    Raises:
        VolumeError: the name ends otherwise, or the file cannot be written.
    """
    if not path.name.lower().endswith(".mha"):
        raise VolumeError(f"{path}: a sequence of images is written as .igs.mha or .mha")
    count, rows, columns = shape
    assert len(times) == count
    assert all(map(math.isfinite, times))
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
        **(header or {}),
    }
    for number, time in enumerate(times):
        fields[f"Seq_Frame{number:04}_ImageStatus"] = "OK"
        fields[f"Seq_Frame{number:04}_Timestamp"] = f"{time:.9g}"
    fields["ElementDataFile"] = "LOCAL"
    with partial_file(path, "image.mha") as partial, partial.open("wb") as file:
        file.write("".join(f"{key} = {value}\n" for key, value in fields.items()).encode("ascii"))
        for image in images:
            file.write(np.ascontiguousarray(image).tobytes())


def _grid_in_mm(
    path: Path, volume: Volume, fields: Mapping[str, str]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return spacing (3,), direction (3, 3) and origin (3,) of a volume that can be written.

    Raises:
        VolumeError: it cannot, or one of the fields cannot stand in a header.
    """
    matrix = volume.index_to_patient[:3, :3] * 1e3
    spacing = np.linalg.norm(matrix, axis=0)
    direction = matrix / spacing
    if not is_right_angled(direction):
        raise VolumeError(
            f"{path}: the volume's axes are {degrees_off(direction):.2g}° off a right angle, which "
            f"image files cannot hold; resample it on a grid with right angles"
        )
    if min(volume.shape) < 2:
        raise VolumeError(
            f"{path}: the volume has {' × '.join(map(str, volume.shape))} voxels; two or more "
            f"along each axis can be written"
        )
    for key, value in fields.items():
        if not (key.isprintable() and value.isprintable()) or set(key) & set(":= ") or not key:
            raise VolumeError(
                f"{path}: the field {key!r} cannot stand in an image header: it must have a name "
                f"without blanks, colons and equals signs, and one line of text"
            )
    return spacing, direction, volume.index_to_patient[:3, 3] * 1e3


def _nrrd_header(path: Path, volume: Volume, fields: Mapping[str, str]) -> str:
    """teem.sourceforge.net/nrrd/format.html, with pairs of keys and values behind the fields."""
    spacing, direction, origin = _grid_in_mm(path, volume, fields)
    lines = [
        "NRRD0004",
        "type: unsigned char",
        "dimension: 3",
        "space: left-posterior-superior",
        f"sizes: {' '.join(map(str, volume.shape))}",
        f"space directions: {' '.join(map(_vector, (direction * spacing).T))}",
        "kinds: domain domain domain",
        "endian: little",
        "encoding: raw",
        f"space origin: {_vector(origin)}",
        *(f"{key}:={value}" for key, value in fields.items()),
    ]
    return "\n".join([*lines, "", ""])


def _vector(numbers: NDArray[np.float64]) -> str:
    """Numbers to their last digit; without -0, which says nothing."""
    return f"({','.join(f'{number + 0.0:.17g}' for number in numbers)})"


def _segment_fields(
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


def _write_image(
    path: Path,
    voxels: NDArray[np.uint8],
    volume: Volume,
    fields: Mapping[str, str],
    *,
    packed: bool,
) -> None:
    """Write voxels (i, j, k) where the volume places them."""
    spacing, direction, origin = _grid_in_mm(path, volume, fields)
    ending = next((end for end in _ENDINGS if path.name.lower().endswith(end)), None)
    if ending is None:
        raise VolumeError(f"{path}: its name must end in {', '.join(_ENDINGS)}")
    with partial_file(path, f"image{ending}") as partial:
        if ending.startswith(".nii"):  # ITK refuses axes that are rounded
            matrix = np.diag([-1e3, -1e3, 1e3, 1.0]) @ volume.index_to_patient
            import nibabel  # which takes half a second

            nifti = nibabel.Nifti1Image(voxels, matrix)  # type: ignore[attr-defined,no-untyped-call]
            nifti.header.set_xyzt_units("mm")
            nifti.to_filename(partial)
            return
        image = sitk.GetImageFromArray(file_order(voxels))
        image.SetSpacing(spacing.tolist())
        image.SetOrigin(origin.tolist())
        image.SetDirection(direction.ravel().tolist())
        for key, value in fields.items():
            image.SetMetaData(key, value)
        try:
            # zlib's fastest level; speckle hardly becomes smaller with any other
            sitk.WriteImage(image, str(partial), packed, 1)
        except RuntimeError as error:
            raise VolumeError(f"{path}: cannot be written: the disk may be full") from error
