"""Volume files into frame ``patient``: MetaImage, NRRD, NIfTI and DICOM."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.dicom.header import find_dicom_files, is_dicom, no_image_error
from us_sim.volume.files.metaimage import open_metaimage, read_metaimage_header
from us_sim.volume.files.nifti import open_nifti
from us_sim.volume.files.nrrd import open_nrrd, read_nrrd_header
from us_sim.volume.files.stored_image import StoredImage, read_grey_voxels
from us_sim.volume.volume import Volume

if TYPE_CHECKING:
    from us_sim.volume.files.dicom.placed_images import PlacedImages

_READERS = {"mha": open_metaimage, "mhd": open_metaimage, "nrrd": open_nrrd, "nhdr": open_nrrd}
_READERS |= {"nii": open_nifti, "hdr": open_nifti, "img": open_nifti}

ENDINGS = (*(f".{ending}" for ending in _READERS), ".nii.gz", ".hdr.gz", ".img.gz")
"""Of the files of these formats; all others are DICOM, or none."""

FRAME_KEY = re.compile(r"Seq_Frame([0-9]+)_(\w+)")
"""Keys of the fields of a frame of a tracked sequence: its number, and the field's name."""


def read_volume(path: str | os.PathLike[str]) -> Volume:
    """Read a scalar 3D image file, or a DICOM series' file or folder, as a volume without labels.

    Frame ``patient`` is the file's own: DICOM's left-posterior-superior axes, in metres. uint8 is
    taken as it is; every other type is mapped linearly so that its smallest finite value becomes 0
    and its largest 255. Of several volumes in time in DICOM the first is taken.

    Raises:
        VolumeError: the file is missing or no image, holds fewer or more bytes than its header
            says, does not fit into memory, is not a scalar three-dimensional image of two voxels
            or more along each axis, or has a spacing, origin or direction that places no volume.

    Examples:
        >>> import tempfile, SimpleITK
        >>> image = SimpleITK.Image([30, 20, 10], SimpleITK.sitkUInt8)
        >>> image.SetSpacing([0.5, 0.5, 1.0]); image.SetOrigin([-7.0, 0.0, 3.0])  # mm
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     SimpleITK.WriteImage(image, f"{folder}/sweep.nrrd")
        ...     volume = read_volume(f"{folder}/sweep.nrrd")
        >>> volume.shape, volume.index_to_patient[0].tolist()
        ((30, 20, 10), [0.0005, 0.0, 0.0, -0.007])
    """
    path = Path(path)
    if placed := _placed_dicom(path):
        return Volume(placed.read_voxels(), placed.placement)
    image, placement = _placed(path)
    return Volume(read_grey_voxels(image)[0], placement)


def read_placement(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read where a volume file's voxels are: (4, 4) from indices to m, from its header alone."""
    path = Path(path)
    placed = _placed_dicom(path)
    return placed.placement if placed else _placed(path)[1]


def open_image(path: Path, *, layers: bool = False) -> StoredImage:
    """Read the header of a MetaImage, NRRD or NIfTI file; its voxels are read on demand.

    With ``layers`` a voxel may have several numbers, as in segmentations of 3D Slicer.

    Raises:
        VolumeError: as `read_volume`, except for faults of the voxels and of where they lie.
    """
    if not path.is_file():
        raise VolumeError(f"{path}: there is no such file")
    if not path.name.lower().endswith(ENDINGS):
        raise no_image_error(
            path, "cannot be read as an image; give an MHA, NRRD, NIfTI or DICOM volume"
        )
    ending = path.name.lower().removesuffix(".gz").rpartition(".")[2]
    if _READERS[ending] is not open_nifti and (use := describe_sequence(path)):
        raise VolumeError(f"{path}: is no volume but {use}")
    image = _READERS[ending](path)
    image.require_volume(layers=layers)
    return image


def is_sequence(kinds: Iterable[str], keys: Iterable[str]) -> bool:
    """Tell whether a header is that of a sequence of frames, not of one volume.

    The last kind of an axis says it (``domain domain list``); a list that comes first is the layers
    of a segmentation. Without kinds, transforms of frames or fields of several frames say it: Plus
    leaves ``Seq_Frame0000_ImageStatus`` in the header of volumes that it has reconstructed.
    """
    if words := [kind.lower() for kind in kinds]:
        return words[-1] in ("list", "time")
    frames = [match for match in map(FRAME_KEY.fullmatch, keys) if match]
    described = {int(match[1]) for match in frames}
    return len(described) > 1 or any(match[2].endswith("Transform") for match in frames)


def describe_sequence(path: Path) -> str | None:
    """Say what a MetaImage or NRRD file of a sequence is, and its use; None of other files."""
    keys, kinds, sizes, _ = read_sequence_header(path)
    if not is_sequence(kinds, keys) or (len(sizes) == 4 and sizes[2] != 1 and sizes[0]):
        return None  # several volumes in time are no sequence of flat images
    frames = [match for match in map(FRAME_KEY.match, keys) if match]
    if "time" not in kinds and len(sizes) == 3 and not frames:
        return None  # Plus also writes volumes with the axes of a sequence, but without frames
    if 0 in sizes:
        return f"a recording of poses without images; play it with `--path {path.name}`"
    if not any(match[2].endswith("Transform") for match in frames):
        return "a sequence of images without poses; record it again with a tracked probe"
    return f"a sequence of tracked frames; give it to `us-sim reconstruct {path.name}`"


def read_sequence_header(path: Path) -> tuple[dict[str, Any], list[str], list[int], int]:
    """Read a MetaImage or NRRD header: keys, kinds and lengths of axes, and its length in bytes."""
    if path.name.lower().endswith((".nrrd", ".nhdr")):
        keys, start = read_nrrd_header(path)
        kinds = [kind.lower() for kind in keys.get("kinds", ())]
        return keys, kinds, [int(length) for length in keys.get("sizes", ())], start
    keys, start = read_metaimage_header(path)
    try:
        sizes = [int(word) for word in keys.get("DimSize", "").split()]
    except ValueError:
        raise VolumeError(f"{path}: its DimSize is {keys['DimSize']!r}; export it again") from None
    return keys, keys.get("Kinds", "").lower().split(), sizes, start


def _placed(path: Path) -> tuple[StoredImage, NDArray[np.float64]]:
    """Open the image of a file with one volume, and its placement."""
    image = open_image(path)
    if image.volumes > 1:
        raise VolumeError(
            f"{path}: holds {image.volumes} volumes; make one of them a file with `us-sim import "
            f"{path.name} --volume 1 --out volume.nrrd`"
        )
    return image, image.placement()


def _placed_dicom(path: Path) -> PlacedImages | None:
    """Open the volume of DICOM files that a path names; None of another format's name."""
    named = path.name.lower().endswith(ENDINGS)
    if not path.is_dir() and (named or not path.is_file() or not is_dicom(path)):
        return None
    from us_sim.volume.files.dicom.placed_images import open_images, place_images

    return place_images(open_images(find_dicom_files(path) if path.is_dir() else [path]))
