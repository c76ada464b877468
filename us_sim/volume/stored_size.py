"""A check that an image file holds the bytes that its header promises.

>>> import tempfile, pathlib
>>> from us_sim.volume.stored_size import check_stored_size
>>> header = "ObjectType = Image\\nNDims = 3\\nDimSize = 4 5 6\\nElementType = MET_SHORT\\n"
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "cut.mha")
...     _ = path.write_bytes(f"{header}ElementDataFile = LOCAL\\n".encode() + bytes(100))
...     check_stored_size(path)  # doctest: +ELLIPSIS
Traceback (most recent call last):
us_sim.errors.VolumeError: ...cut.mha: holds 100 bytes of image data where its header says 240; ...
"""

from __future__ import annotations

import math
from pathlib import Path

from us_sim.volume.metaimage import metaimage_header, metaimage_voxels
from us_sim.volume.nifti import nifti_voxels
from us_sim.volume.nrrd import nrrd_voxels
from us_sim.volume.stored_voxels import StoredVoxels

__all__ = ["check_stored_size"]


def check_stored_size(path: Path) -> int | None:
    """Compare the bytes of image data in a MetaImage, NRRD or NIfTI file with its header.

    Returns:
        The bytes of image data; None for files of other formats, which pass.

    Raises:
        VolumeError: the file holds fewer or more bytes, its header is none of the format's, its
            data file is missing, its compression is broken, or it is larger than what is read.
    """
    voxels = _voxels(path)
    if voxels is None:
        return None
    voxels.check()
    return math.prod(voxels.size) * voxels.value


def _voxels(path: Path) -> StoredVoxels | None:
    name = path.name.lower()
    if name.endswith((".mha", ".mhd")):
        return metaimage_voxels(path, *metaimage_header(path))
    if name.endswith((".nrrd", ".nhdr")):
        return nrrd_voxels(path)
    if name.endswith((".nii", ".nii.gz")):
        return nifti_voxels(path)
    return None
