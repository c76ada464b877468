"""A check that an image file holds the bytes that its header promises.

>>> import tempfile, pathlib
>>> from us_sim.volume.files.stored_size import check_stored_size
>>> header = "ObjectType = Image\\nNDims = 3\\nDimSize = 4 5 6\\nElementType = MET_SHORT\\n"
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "cut.mha")
...     _ = path.write_bytes(f"{header}ElementDataFile = LOCAL\\n".encode() + bytes(100))
...     check_stored_size(path)  # doctest: +ELLIPSIS
Traceback (most recent call last):
us_sim.errors.VolumeError: ...cut.mha: holds 100 bytes of image data where its header says 240; ...
"""

from __future__ import annotations

from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.volume.files.metaimage import metaimage_header, metaimage_voxels
from us_sim.volume.files.nifti import nifti_voxels
from us_sim.volume.files.nrrd import nrrd_voxels
from us_sim.volume.files.stored_voxels import StoredVoxels

__all__ = ["check_stored_size"]


def check_stored_size(path: Path) -> StoredVoxels:
    """Compare the bytes of image data in a MetaImage, NRRD or NIfTI file with its header.

    Returns:
        What the header says.

    Raises:
        VolumeError: the file is of another format, holds fewer or more bytes, its header is none of
            the format's, its data file is missing, its compression is broken, or it is larger than
            what is read.
    """
    voxels = _voxels(path)
    voxels.check()
    return voxels


def _voxels(path: Path) -> StoredVoxels:
    name = path.name.lower()
    if name.endswith((".mha", ".mhd")):
        return metaimage_voxels(path, *metaimage_header(path))
    if name.endswith((".nrrd", ".nhdr")):
        return nrrd_voxels(path)
    if name.endswith((".nii", ".nii.gz")):
        return nifti_voxels(path)
    raise VolumeError(
        f"{path}: cannot be read as an image; give an MHA, NRRD, NIfTI or DICOM volume, which 3D "
        f"Slicer makes of others"
    )
