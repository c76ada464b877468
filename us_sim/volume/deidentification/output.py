"""Writing what goes on: a volume's file, a case, or a sequence of images."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.deidentification.imported import Imported
from us_sim.volume.deidentification.rectangle import Rectangle
from us_sim.volume.deidentification.settings import ImportSettings
from us_sim.volume.deidentification.source import Progress, Source
from us_sim.volume.files.writing import write_volume
from us_sim.volume.sequences.image_sequence_file import write_image_sequence
from us_sim.volume.volume import Volume

_VOLUMES = (".nrrd", ".mha", ".nii", ".nii.gz")


def is_images(out: Path) -> bool:
    """Whether a name is one of those that 2D images may have."""
    return out.name.lower().endswith(".mha")


def refuse_taken(out: Path) -> None:
    """Refuse a place where something is already, or a name that is none.

    Raises:
        VolumeError: it is taken.
    """
    if os.path.lexists(out):
        raise VolumeError(f"{out}: exists already; choose another name, or remove it")
    if out.suffix and not out.name.lower().endswith(_VOLUMES) and len(out.suffix) <= 5:
        raise VolumeError(
            f"{out}: its name ends as no volume's does; write {', '.join(_VOLUMES)}, .igs.mha for "
            f"2D images, or a folder's name without an ending for a case"
        )


def write_images(
    out: Path,
    source: Source,
    keep: NDArray[np.bool_] | None,
    part: Rectangle | None,
    progress: Progress | None,
) -> None:
    """Images without a place, one after another in time.

    Raises:
        VolumeError: they cannot be read or written.
    """
    assert source.images is not None
    columns, rows, count = source.shape
    cut = part.slices if part else (slice(None), slice(None))
    columns, rows = part.size if part else (columns, rows)

    def told() -> Iterator[NDArray[np.uint8]]:
        assert source.images is not None
        for number, image in enumerate(source.images(keep), start=1):
            yield image[cut]
            if progress:
                progress(number / count, f"{number} of {count} images")

    write_image_sequence(
        out, told(), (count, rows, columns), source.times, source.pixel_mm, source.kept
    )


def write_grid(
    out: Path,
    source: Source,
    keep: NDArray[np.bool_] | None,
    imported: Imported,
    settings: ImportSettings,
    progress: Progress | None,
) -> None:
    """A volume as a file, or as a new case where the name has no ending.

    Raises:
        VolumeError: it cannot be read or written.
        CaseError: the case cannot be made.
    """
    assert source.voxels is not None
    assert source.placement is not None
    volume = _cropped(source.voxels(keep, progress), source.placement, settings.part)
    if out.name.lower().endswith(_VOLUMES):
        fields = {} if out.name.lower().endswith((".nii", ".nii.gz")) else dict(source.kept)
        write_volume(out, volume, fields)
        return
    from us_sim.volume.cases.provenance import Step, add_step
    from us_sim.volume.cases.settings import CaseSettings
    from us_sim.volume.cases.writing import new_case, write_case_settings

    with new_case(out) as folder:
        write_volume(folder / "volume.nrrd", volume, source.kept)
        del volume  # it is read again at the end, to propose where to start
        write_case_settings(folder, CaseSettings(name=settings.name or out.name))
        add_step(folder, Step("imported", _said(imported, settings), _counted(imported)))


def _said(imported: Imported, settings: ImportSettings) -> dict[str, object]:
    """For provenance: what was done, by nothing that the source's header says."""
    said: dict[str, object] = {"kind": imported.kind, "values kept": sorted(imported.kept)}
    if settings.crop:
        said["crop"] = settings.crop
    if settings.keep_whole_image:
        said["whole image"] = True
    if imported.conversions:
        said["converted"] = list(imported.conversions)
    return said


def _counted(imported: Imported) -> dict[str, int]:
    return {
        "files": imported.files,
        "elements dropped": sum(imported.dropped.values()),
        "regions kept": len(imported.regions),
        "places that may be text": len(imported.remaining),
    }


def _cropped(
    voxels: NDArray[np.uint8], placement: NDArray[np.float64], part: Rectangle | None
) -> Volume:
    """The part of every image, where it was."""
    if part is None:
        return Volume(voxels, placement)
    if min(part.size) < 2:
        raise VolumeError(f"--crop {part}: a volume needs two columns and rows or more")
    rows, columns = part.slices
    moved = placement.copy()
    moved[:, 3] = placement @ [part.left, part.top, 0.0, 1.0]
    return Volume(voxels[columns, rows], moved)
