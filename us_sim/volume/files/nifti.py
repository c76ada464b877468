"""NIfTI files of both versions, in one file or in two, read by nibabel."""

from __future__ import annotations

import zlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.placement import is_right_angled, make_placement
from us_sim.volume.files.stored_image import StoredImage

_TO_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])  # NIfTI's x goes to the right, its y to the front
_OF_TWO_SIZES = 1e-2  # by which the sizes of voxels may differ that a header states twice


def open_nifti(path: Path) -> StoredImage:
    """Describe the image of a file, or of a pair of ``.hdr`` and ``.img``, each packed or not."""
    import nibabel  # which takes half a second

    faults = (
        nibabel.filebasedimages.ImageFileError,
        nibabel.spatialimages.HeaderDataError,
        *(OSError, EOFError, zlib.error, ValueError, OverflowError),
    )
    try:
        image: Any = nibabel.load(path)
        if not isinstance(image, nibabel.Nifti1Pair):  # type: ignore[attr-defined]
            raise ValueError("Analyze 7.5, which does not say which side is left; save it as NIfTI")
        if image.header["qform_code"] > 0:
            image.get_qform()  # raises where its quaternion is none
    except faults as error:
        raise VolumeError(
            f"{path}: cannot be read as an image: {' '.join(str(error).split())}; give an MHA, "
            f"NRRD or NIfTI volume"
        ) from error
    kind = image.get_data_dtype()
    if kind.kind not in "iuf":
        raise VolumeError(f"{path}: holds {kind} numbers; save it as whole or floating-point ones")
    size = tuple(int(length) for length in image.shape)
    while len(size) > 3 and size[-1] == 1:
        size = size[:-1]

    def read() -> NDArray[Any]:
        try:
            return np.asanyarray(image.dataobj).reshape(size, order="F")
        except faults as error:
            raise VolumeError(
                f"{path}: its image data are broken or cut ({error}); copy it again"
            ) from error

    return StoredImage(path, size, kind, 1, partial(_placement, path, image), read)


def _placement(path: Path, image: Any, given: ArrayLike | None = None) -> NDArray[np.float64]:
    """Place the voxels, (4, 4) m: by the affine matrix, the quaternion, or the spacing alone.

    A matrix whose axes are not at right angles gives way to a quaternion, as in ITK.
    """
    header, files = image.header, image.file_map
    # mm of metres, millimetres and micrometres; 0 is not stated, and millimetres by custom
    unit = {1: 1e3, 2: 1.0, 3: 1e-3}.get(int(header["xyzt_units"]) & 7, 1.0)
    with files.get("header", files["image"]).get_prepare_fileobj("rb") as file:
        # Unchecked, since nibabel's own header has 1 mm where the file has 0.
        pixdim = type(header).from_fileobj(file, check=False)["pixdim"][1:4].astype(float)
    spacing = np.abs(pixdim) if np.isfinite(pixdim).all() and pixdim.all() else None
    sform, matrix = header.get_sform(), _TO_LPS  # no turn
    steps = np.linalg.norm(sform[:3, :3], axis=0)
    is_square = is_right_angled(sform[:3, :3] / np.where(steps > 0.0, steps, 1.0))
    if header["sform_code"] > 0 and (is_square or header["qform_code"] <= 0):
        matrix, stated, spacing = sform, spacing, steps
        if is_square and stated is not None and not np.allclose(steps, stated, rtol=_OF_TWO_SIZES):
            spacing = None
            if given is None:
                two = (" × ".join(f"{each:g}" for each in sizes) for sizes in (steps, stated))
                raise VolumeError(
                    f"{path}: states two sizes of its voxels, {' and '.join(two)} (sform and "
                    f"pixdim): say the right one with `us-sim import --spacing X,Y,Z` (mm)"
                )
    elif header["qform_code"] > 0:
        matrix = header.get_qform()
    placed = _TO_LPS @ matrix
    lengths = np.linalg.norm(placed[:3, :3], axis=0)
    direction = placed[:3, :3] / np.where(lengths > 0.0, lengths, 1.0)
    return make_placement(
        path, None if spacing is None else unit * spacing, direction, unit * placed[:3, 3], given
    )
