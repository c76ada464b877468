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
from us_sim.volume.files.readers import grey_voxels, open_image
from us_sim.volume.files.segments import holds_segments, no_grey_values

_KINDS = {"m": "MetaImage volume", "nr": "NRRD volume", "nh": "NRRD volume"}
"""By the beginning of a name's ending; all others are NIfTI."""


def file_source(path: Path, volume: int, spacing: tuple[float, ...] | None) -> Source:
    """The slices of a volume along its last axis.

    Args:
        path: of the file.
        volume: which one where there are several.
        spacing: (3,) mm, of a file that does not state it.

    Raises:
        VolumeError: as `read_volume`, and of a segmentation of 3D Slicer.
    """
    image = open_image(path, layers=True, spacing=spacing)
    if holds_segments(image.texts):
        raise no_grey_values(path)
    image.check(layers=False)
    placement = image.placement()
    voxels, conversions = grey_voxels(image, volume)
    count = voxels.shape[2]

    def blanked(keep: NDArray[np.bool_] | None, _: Progress | None) -> NDArray[np.uint8]:
        return voxels if keep is None else np.where(keep.T[:, :, None], voxels, np.uint8(0))

    def slices(keep: NDArray[np.bool_] | None) -> Iterator[NDArray[np.uint8]]:
        for k in range(count):
            image = np.ascontiguousarray(voxels[:, :, k].T)
            yield image if keep is None else np.where(keep, image, np.uint8(0))

    def sides(keep: NDArray[np.bool_] | None) -> Iterator[list[NDArray[np.uint8]]]:
        for axis in (0, 1):
            stack = []
            for n in spread(voxels.shape[axis]):
                image = np.ascontiguousarray(np.take(voxels, n, axis))
                if keep is not None:
                    image[~np.take(keep, n, 1 - axis)] = 0
                stack.append(image)
            yield stack

    ending = path.name.lower().removesuffix(".gz").rpartition(".")[2]
    kinds = (kind for start, kind in _KINDS.items() if ending.startswith(start))
    return Source(
        kind=next(kinds, "NIfTI volume"),
        shape=image.shape,
        samples=[np.ascontiguousarray(voxels[:, :, k].T) for k in spread(count)],
        names=other_names(path),
        kept={},
        conversions=conversions,
        regions=Regions(()),
        placement=placement,
        times=[],
        pixel_mm=(1.0, 1.0),
        voxels=blanked,
        images=slices,
        sides=sides,
    )
