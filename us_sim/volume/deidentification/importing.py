"""Files of scanners and other programs into a volume, a case or a sequence of images.

Only voxels, where and when they lie, and the values of `kept_values` go on. The source is read,
what is not kept is blanked, and the result is written anew: nothing is copied.

>>> import pydicom.data
>>> from us_sim.volume.deidentification.importing import look_at
>>> from us_sim.volume.deidentification.settings import ImportSettings
>>> file = pydicom.data.get_testdata_file("examples_ybr_color.dcm")
>>> look_at([file], None, ImportSettings(crop="80,30,240,210")).imported.what
'30 images of 161 × 181 pixels'
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.spelling import counted
from us_sim.volume.deidentification.file_source import file_source
from us_sim.volume.deidentification.imported import Imported
from us_sim.volume.deidentification.kept_part import Regions
from us_sim.volume.deidentification.kept_values import sorted_out
from us_sim.volume.deidentification.output import is_images, refuse_taken, write_grid, write_images
from us_sim.volume.deidentification.proposal import proposed_part
from us_sim.volume.deidentification.rectangle import Rectangle
from us_sim.volume.deidentification.settings import ImportSettings
from us_sim.volume.deidentification.source import Progress, Source
from us_sim.volume.deidentification.text_detection import find_text
from us_sim.volume.files.dicom.header import dicom_files, is_dicom, packed_in
from us_sim.volume.files.readers import ENDINGS

_MARGIN = 3
"""Pixels around text that are blanked with it: shadows and blurred edges."""


@dataclass(frozen=True, eq=False)
class Import:
    """Files that were looked at, and what would be made of them."""

    paths: list[Path]
    out: Path | None
    settings: ImportSettings
    source: Source
    imported: Imported  # the facts of the report
    keep: NDArray[np.bool_] | None  # (rows, columns) of every image; None: all of it

    def write(self, progress: Progress | None = None) -> None:
        """Write what goes on.

        Raises:
            VolumeError: a person has to say first what of the images is kept; or they cannot be
                read, or the result not written.
            CaseError: the case cannot be made.
        """
        assert self.out is not None
        if self.imported.undecided:
            raise VolumeError(
                f"{self.paths[0]}: {self.imported.undecided}; {_advice(self.imported)}"
            )
        if self.source.placement is None:
            write_images(self.out, self.source, self.keep, self.settings.part, progress)
        else:
            write_grid(self.out, self.source, self.keep, self.imported, self.settings, progress)


def look_at(
    files: Sequence[str | os.PathLike[str]], out: Path | None, settings: ImportSettings
) -> Import:
    """Find out what would go on, and write nothing.

    Args:
        files: DICOM files of one series, or a folder of them; or one MetaImage, NRRD or NIfTI
            volume.
        out: a new case's folder, or a file with a volume's ending, or for 2D images .igs.mha; None
            where nothing will be written.
        settings: what is kept.

    Raises:
        VolumeError: a file cannot be read, the files do not belong together, there is something at
            ``out`` already, or it needs a volume and the files hold none.
    """
    paths = _listed(files)
    if out is not None:
        refuse_taken(out)
    source = _source(paths, out, settings)
    imported, keep = _looked_at(paths, source, settings)
    return Import(paths, out, settings, source, imported, keep)


def import_files(
    files: Sequence[str | os.PathLike[str]],
    out: Path,
    settings: ImportSettings | None = None,
    progress: Progress | None = None,
) -> Imported:
    """De-identify files into ``out``; see `look_at` and `Import.write`."""
    found = look_at(files, out, settings or ImportSettings())
    found.write(progress)
    return found.imported


def _listed(files: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """The files, and in place of a folder the DICOM files in it."""
    paths: list[Path] = []
    for each in map(Path, files):
        if each.is_dir():
            paths += dicom_files(each)
        elif not each.is_file():
            raise VolumeError(f"{each}: there is no such file")
        else:
            paths.append(each)
    return paths


def _source(paths: list[Path], out: Path | None, settings: ImportSettings) -> Source:
    others = [path for path in paths if path.name.lower().endswith(ENDINGS)]
    spacing = settings.spacing_mm
    needs_volume = out is not None and not is_images(out)
    if spacing and len(spacing) != (3 if others or needs_volume else 2):
        raise VolumeError(
            "--spacing: write three numbers for a volume, X,Y,Z, and two for 2D images, X,Y"
        )
    if len(paths) == 1 and others:
        return file_source(paths[0], settings.volume, spacing or None)
    strange = [*others, *(path for path in paths if path not in others and not is_dicom(path))]
    if strange:
        if packed := packed_in(strange[0]):
            raise VolumeError(f"{strange[0]}: is packed as {packed}; unpack it first")
        raise VolumeError(
            f"{strange[0]}: is no DICOM file; give the DICOM files of one series, or one MHA, NRRD "
            f"or NIfTI volume"
        )
    # Imported where it is needed: DICOM is an extra.
    from us_sim.volume.deidentification.dicom_source import dicom_source

    return dicom_source(paths, settings.volume, spacing, needs_volume=needs_volume)


def _looked_at(
    paths: list[Path], source: Source, settings: ImportSettings
) -> tuple[Imported, NDArray[np.bool_] | None]:
    """What would be done, and what of every image is kept where that is not all of it."""
    regions, undecided = _kept_part(source, settings)
    columns, rows, _ = source.shape
    keep = regions.mask(rows, columns) if regions.kept else np.ones((rows, columns), bool)
    found = find_text(source.samples)
    marked = [line for line in found if keep[line.slices].any()] if settings.blank_text else []
    for line in marked:
        keep[line.grown(_MARGIN).slices] = False
    remaining = tuple(line for line in found if keep[line.slices].any())
    sides = source.sides(None if keep.all() else keep) if source.sides else ()
    across = sum(len(find_text(side)) for side in sides)
    is_told = settings.part is not None or settings.keep_whole_image
    if (remaining or across) and not undecided and not is_told:
        others = f", and {across} in slices across its other axes" if across else ""
        undecided = f"{len(remaining)} places that would go on may be text{others}"
    used, dropped = sorted_out(source.names, source.kept)
    imported = Imported(
        kind=source.kind,
        files=len(paths),
        what=_what(source, settings.part),
        kept=source.kept,
        used=used,
        dropped=dropped,
        conversions=source.conversions,
        blanked=_blanked(source, regions, settings, undecided, len(marked)),
        first=source.samples[0],
        regions=regions.kept,
        text=tuple(found),
        remaining=remaining,
        undecided=undecided,
        blanking_settles=bool(undecided) and not source.regions.doubt and not across,
        proposal=proposed_part(source.samples, found) if undecided else None,
    )
    return imported, None if keep.all() else keep


def _kept_part(source: Source, settings: ImportSettings) -> tuple[Regions, str]:
    """What is kept of every image, and why a person has to decide, where that is so."""
    part = settings.part
    if part is not None:
        columns, rows, _ = source.shape
        if part.right >= columns or part.bottom >= rows:
            raise VolumeError(
                f"--crop {part}: is larger than the images, whose last column is {columns - 1} "
                f"and last row {rows - 1}"
            )
        return Regions((part,)), ""
    if settings.keep_whole_image:
        return Regions(()), ""
    if source.regions.doubt:
        return Regions(()), (
            f"names and dates may be burned into its images, and nothing says which part of them "
            f"holds echoes ({source.regions.doubt})"
        )
    return source.regions, ""


def _advice(imported: Imported) -> str:
    blank = "--blank-text, " if imported.blanking_settles else ""
    proposed = f"{imported.proposal} (a proposal)" if imported.proposal else "X0,Y0,X1,Y1"
    return (
        f"look at the picture of --report, then give --crop {proposed}, {blank}or "
        f"--keep-whole-image if there is nothing to hide"
    )


def _what(source: Source, part: Rectangle | None) -> str:
    """What is made, with its size."""
    columns, rows, count = source.shape
    if part is not None:
        columns, rows = part.size
    if source.placement is None:
        return f"{counted(count, 'image')} of {columns} × {rows} pixels"
    steps = np.linalg.norm(source.placement[:3, :3], axis=0) * 1e3
    apart = " × ".join(f"{step:.4g}" for step in steps)
    return f"a volume of {columns} × {rows} × {count} voxels of {apart} mm"


def _blanked(
    source: Source, regions: Regions, settings: ImportSettings, undecided: str, lines: int
) -> str:
    if undecided:
        return "nothing yet: it has to be said what is kept"
    marked = f"; {counted(lines, 'place')} that may be text" if lines else ""
    if settings.part is not None:
        return f"all but columns and rows {settings.part} is cut off{marked}"
    if not regions.kept:
        said = f"no text was found in {len(source.samples)} of {source.shape[2]} images"
        said = "as was said" if settings.keep_whole_image else said
        return f"{counted(lines, 'place')} that may be text" if lines else f"nothing ({said})"
    kept = ", ".join(map(str, regions.kept))
    others = f", and {regions.blanked} of other kinds" if regions.blanked else ""
    return f"everything outside the ultrasound regions {kept}{others}{marked}"
