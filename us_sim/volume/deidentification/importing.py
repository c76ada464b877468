"""Files of scanners and other programs into a volume, a case or a sequence of images.

Only voxels, where and when they lie, and the values of `kept_values` go on. The source is read,
the rest is blanked, and the result is written anew: nothing is copied.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.spelling import counted
from us_sim.volume.deidentification.kept_values import sorted_out
from us_sim.volume.deidentification.settings import ImportSettings, Rectangle
from us_sim.volume.deidentification.source import (
    Progress,
    Regions,
    Source,
    dicom_source,
    file_source,
)
from us_sim.volume.deidentification.text_detection import find_text, proposed_part
from us_sim.volume.files.dicom.header import dicom_files, is_dicom, packed_in
from us_sim.volume.files.readers import ENDINGS
from us_sim.volume.files.writing import write_image_sequence, write_volume
from us_sim.volume.volume import Volume

_MARGIN = 3
"""Pixels around text that are blanked with it: shadows and blurred edges."""

_VOLUMES = (".nrrd", ".mha", ".nii", ".nii.gz")


@dataclass(frozen=True, eq=False)
class Imported:
    """The facts of an import's report, before or after it is written."""

    kind: str  # of the files: "DICOM, Enhanced US Volume Storage", "NRRD volume"
    files: int
    what: str  # the result, with its size, for a person
    kept: Mapping[str, str]  # values that go on, by their fields
    used: Mapping[str, int]  # elements of which only the effect goes on, and how many of each
    dropped: Mapping[str, int]  # all others
    conversions: tuple[str, ...]
    blanked: str  # the part of the images that is not kept, for a person
    first: NDArray[np.uint8]  # (rows, columns) the first image as it was: it may show a name
    regions: tuple[Rectangle, ...]  # its parts that are kept
    text: tuple[Rectangle, ...]  # where text may be, in `first`
    remaining: tuple[Rectangle, ...]  # of these, those that are kept: partly or wholly
    undecided: str = ""  # why nothing can be written before a person has decided
    blanking_settles: bool = False  # that --blank-text would be a decision
    proposal: Rectangle | None = None  # the part to keep, by its movement and brightness


@dataclass(frozen=True, eq=False)
class Import:
    """Files that were looked at, and the result that is planned."""

    paths: list[Path]
    out: Path | None
    settings: ImportSettings
    source: Source
    imported: Imported
    keep: NDArray[np.bool_] | None  # (rows, columns) of every image; None: all of it

    def write(self, progress: Progress | None = None) -> None:
        """Write the result.

        Raises:
            VolumeError: a person has to say first which part of the images is kept; or they cannot
                be read, or the result not written.
            CaseError: the case cannot be made.
        """
        facts = self.imported
        assert self.out is not None
        if facts.undecided:
            blank = "--blank-text, " if facts.blanking_settles else ""
            proposed = f"{facts.proposal} (a proposal)" if facts.proposal else "X0,Y0,X1,Y1"
            raise VolumeError(
                f"{self.paths[0]}: {facts.undecided}; look at the picture of --report, then give "
                f"--crop {proposed}, {blank}or --keep-whole-image if there is nothing to hide"
            )
        if self.source.placement is None:
            self._write_images(self.out, progress)
        else:
            self._write_volume(self.out, self.source.placement, progress)

    def _write_images(self, out: Path, progress: Progress | None) -> None:
        """Images without a place, one after another in time."""
        source, part = self.source, self.settings.part
        columns, rows, count = source.shape
        cut = part.slices if part else (slice(None), slice(None))
        columns, rows = part.size if part else (columns, rows)

        def images() -> Iterator[NDArray[np.uint8]]:
            assert source.images is not None
            for number, image in enumerate(source.images(self.keep), start=1):
                yield image[cut]
                if progress:
                    progress(number / count, f"{number} of {count} images")

        shape = (count, rows, columns)
        write_image_sequence(out, images(), shape, source.times, source.pixel_mm, source.kept)

    def _write_volume(
        self, out: Path, placement: NDArray[np.float64], progress: Progress | None
    ) -> None:
        """A volume as a file, or as a new case where the name has no ending."""
        source, facts = self.source, self.imported
        assert source.voxels is not None
        volume = _cropped(source.voxels(self.keep, progress), placement, self.settings.part)
        if out.name.lower().endswith(_VOLUMES):
            fields = {} if out.name.lower().endswith((".nii", ".nii.gz")) else dict(source.kept)
            write_volume(out, volume, fields)
            return
        from us_sim.volume.cases.provenance import Step, add_step
        from us_sim.volume.cases.settings import CaseSettings
        from us_sim.volume.cases.writing import new_case, write_case_settings

        said: dict[str, object] = {"kind": facts.kind, "values kept": sorted(facts.kept)}
        if self.settings.crop:
            said["crop"] = self.settings.crop
        if self.settings.keep_whole_image:
            said["whole image"] = True
        if facts.conversions:
            said["converted"] = list(facts.conversions)
        counts = {
            "files": facts.files,
            "elements dropped": sum(facts.dropped.values()),
            "regions kept": len(facts.regions),
            "places that may be text": len(facts.remaining),
        }
        with new_case(out) as folder:
            write_volume(folder / "volume.nrrd", volume, source.kept)
            del volume  # it is read again at the end, to propose where to start
            write_case_settings(folder, CaseSettings(name=self.settings.name or out.name))
            add_step(folder, Step("imported", said, counts))


def look_at(
    files: Sequence[str | os.PathLike[str]], out: Path | None, settings: ImportSettings
) -> Import:
    """Plan an import, and write nothing.

    Args:
        files: DICOM files of one series, or a folder of them; or one MetaImage, NRRD or NIfTI
            volume.
        out: a new case's folder, or a file with a volume's ending, or for 2D images .igs.mha; None
            where nothing will be written.
        settings: which part is kept.

    Raises:
        VolumeError: a file cannot be read, the files do not belong together, there is something at
            ``out`` already, or it needs a volume and the files hold none.
    """
    paths: list[Path] = []
    for each in map(Path, files):
        if not each.is_dir() and not each.is_file():
            raise VolumeError(f"{each}: there is no such file")
        paths += dicom_files(each) if each.is_dir() else [each]
    if out is not None:
        _check_free(out)
    source = _source(paths, out, settings)
    imported, keep = _planned(paths, source, settings)
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


def _check_free(out: Path) -> None:
    """Refuse a place where something is already, or a name that is none."""
    if os.path.lexists(out):
        raise VolumeError(f"{out}: exists already; choose another name, or remove it")
    if out.suffix and not out.name.lower().endswith(_VOLUMES) and len(out.suffix) <= 5:
        raise VolumeError(
            f"{out}: its name ends as no volume's does; write {', '.join(_VOLUMES)}, .igs.mha for "
            f"2D images, or a folder's name without an ending for a case"
        )


def _source(paths: list[Path], out: Path | None, settings: ImportSettings) -> Source:
    others = [path for path in paths if path.name.lower().endswith(ENDINGS)]
    spacing = settings.spacing_mm
    needs_volume = out is not None and not out.name.lower().endswith(".mha")
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
    return dicom_source(paths, settings.volume, spacing, needs_volume=needs_volume)


def _planned(
    paths: list[Path], source: Source, settings: ImportSettings
) -> tuple[Imported, NDArray[np.bool_] | None]:
    """The facts of an import, and the part of every image that is kept where that is not all."""
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
        what=_result(source, settings.part),
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
    """The part of every image that is kept, and why a person has to decide, where that is so."""
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


def _result(source: Source, part: Rectangle | None) -> str:
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


def _cropped(
    voxels: NDArray[np.uint8], placement: NDArray[np.float64], part: Rectangle | None
) -> Volume:
    if part is None:
        return Volume(voxels, placement)
    if min(part.size) < 2:
        raise VolumeError(f"--crop {part}: a volume needs two columns and rows or more")
    rows, columns = part.slices
    moved = placement.copy()
    moved[:, 3] = placement @ [part.left, part.top, 0.0, 1.0]
    return Volume(voxels[columns, rows], moved)
