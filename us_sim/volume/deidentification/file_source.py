"""A volume of another format, MetaImage, NRRD or NIfTI, as a source of an import.

Of its header nothing goes on but where the voxels lie: comments, descriptions and fields that some
programs copy there from DICOM are dropped.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.volume.deidentification.header_names import other_names
from us_sim.volume.deidentification.kept_part import Regions
from us_sim.volume.deidentification.source import Progress, Source, spread
from us_sim.volume.files.readers import read_volume

__all__ = ["ENDINGS", "file_source"]

ENDINGS = {
    ".mha": "MetaImage volume",
    ".mhd": "MetaImage volume",
    ".nrrd": "NRRD volume",
    ".nhdr": "NRRD volume",
    ".nii": "NIfTI volume",
    ".nii.gz": "NIfTI volume",
}


def file_source(path: Path) -> Source:
    """The slices of a volume along its last axis.

    Raises:
        VolumeError: as `read_volume`.
    """
    volume = read_volume(path)
    voxels = volume.intensities

    def blanked(keep: NDArray[np.bool_] | None, _: Progress | None) -> NDArray[np.uint8]:
        return voxels if keep is None else np.where(keep.T[:, :, None], voxels, np.uint8(0))

    def slices(keep: NDArray[np.bool_] | None) -> Iterator[NDArray[np.uint8]]:
        for k in range(volume.shape[2]):
            image = np.ascontiguousarray(voxels[:, :, k].T)
            yield image if keep is None else np.where(keep, image, np.uint8(0))

    name = path.name.lower()
    return Source(
        kind=next(kind for ending, kind in ENDINGS.items() if name.endswith(ending)),
        shape=volume.shape,
        samples=[np.ascontiguousarray(voxels[:, :, k].T) for k in spread(volume.shape[2])],
        names=other_names(path),
        kept={},
        conversions=(),
        regions=Regions(()),
        trusted=True,
        placement=volume.index_to_patient,
        times=[],
        pixel_mm=(1.0, 1.0),
        voxels=blanked,
        images=slices,
    )
