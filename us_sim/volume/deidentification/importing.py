"""Files of scanners and other programs into a volume, a case or a sequence of images.

Only voxels, their place and time, and the values of `kept_values` go on. The source is read, the
rest is blanked, and the result is written anew: nothing is copied.
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
from us_sim.volume.deidentification.settings import ImportSettings, Rectangle
from us_sim.volume.deidentification.source import (
    Progress,
    Scale,
    Source,
    dicom_source,
    file_source,
)
from us_sim.volume.files.dicom.header import dicom_files, is_dicom, refuse_other
from us_sim.volume.files.readers import ENDINGS
from us_sim.volume.files.writing import write_image_sequence, write_volume
from us_sim.volume.volume import Volume

_VOLUMES = (".nrrd", ".mha", ".nii", ".nii.gz")


@dataclass(frozen=True, eq=False)
class Imported:
    """The facts of an import's report, before or after it is written."""

    kind: str  # of the files: "DICOM, Enhanced US Volume Storage", "NRRD volume"
    files: int
    what: str  # the result, with its size, for a person
    kept: Mapping[str, str]  # values that go on, by their fields
    dropped: Mapping[str, int]  # all other elements, and how many of each
    conversions: tuple[str, ...]
    blanked: str  # the part of the images that is not kept, for a person
    first: NDArray[np.uint8]  # (rows, columns) the first image as it was: it may show a name
    parts: tuple[Rectangle, ...]  # of it, those that are kept
    undecided: str = ""  # what a person has to say before anything can be written


@dataclass(frozen=True, eq=False)
class Import:
    """Files that were looked at, and the result that is planned."""

    paths: list[Path]
    out: Path | None
    settings: ImportSettings
    source: Source
    imported: Imported
    keep: NDArray[np.bool_] | None  # (rows, columns) of every image; None: all of it
    pixel_mm: Scale | None  # of images without a place

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
            raise VolumeError(f"{self.paths[0]}: {facts.undecided}")
        if self.source.placement is None:
            self._write_images(self.out, progress)
        else:
            self._write_volume(self.out, self.source.placement, progress)

    def _write_images(self, out: Path, progress: Progress | None) -> None:
        """Images without a place, one after another in time."""
        source, part = self.source, self.settings.part
        assert self.pixel_mm is not None
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
        write_image_sequence(out, images(), shape, source.times, self.pixel_mm, source.kept)

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
            "regions kept": len(facts.parts),
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
    return _planned(paths, out, settings, source)


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
    if len(paths) == 1 and others:
        if len(spacing) == 2:
            raise VolumeError("--spacing: write three numbers for a volume: X,Y,Z")
        return file_source(paths[0], settings.volume, spacing or None)
    strange = [*others, *(path for path in paths if path not in others and not is_dicom(path))]
    if strange:
        raise refuse_other(
            strange[0],
            "is no DICOM file; give DICOM files of one series, or one MHA, NRRD or NIfTI volume",
        )
    return dicom_source(paths, settings.volume, spacing, needs_volume=needs_volume)


def _planned(
    paths: list[Path], out: Path | None, settings: ImportSettings, source: Source
) -> Import:
    """Find out what of every image is kept, and its scale."""
    columns, rows, _ = source.shape
    whole = Rectangle(0, 0, columns - 1, rows - 1)
    part = settings.part or whole
    if part.common(whole) != part:
        raise VolumeError(
            f"--crop {part}: is larger than the images, whose last column is {columns - 1} and "
            f"last row {rows - 1}"
        )
    regions = () if settings.keep_whole_image else source.regions.kept
    shown = tuple(filter(None, (part.common(region.part) for region in regions)))
    if regions and not shown:
        raise VolumeError(
            f"--crop {part}: shows nothing of the ultrasound regions "
            f"{', '.join(str(region.part) for region in regions)}; keep a part of these, or give "
            f"--keep-whole-image with it if there is nothing to hide"
        )
    keep = np.full((rows, columns), not regions)
    for each in shown:
        keep[each.slices] = True
    is_told = settings.part is not None or settings.keep_whole_image
    undecided = ""
    if source.needs_part and not regions and not is_told:
        undecided = (
            f"names and dates may be burned into its images, and nothing says which part of them "
            f"holds echoes ({source.regions.doubt}); look at the picture of --report, then give "
            f"--crop X0,Y0,X1,Y1, or --keep-whole-image if there is nothing to hide"
        )
    pixel = None
    if source.placement is None:
        pixel, unknown = _scale(paths[0], source, part, settings.spacing_mm)
        undecided = "; ".join(filter(None, (undecided, unknown)))
    facts = Imported(
        kind=source.kind,
        files=len(paths),
        what=_result(source, part, pixel),
        kept=source.kept,
        dropped=source.dropped,
        conversions=source.conversions,
        blanked=_blanked(source, settings, shown, undecided),
        first=source.first,
        parts=shown or ((part,) if settings.part else ()),
        undecided=undecided,
    )
    return Import(paths, out, settings, source, facts, None if keep.all() else keep, pixel)


def _scale(
    path: Path, source: Source, part: Rectangle, given: tuple[float, ...]
) -> tuple[Scale | None, str]:
    """Return the size of pixels in a part of an image, mm, or what a person has to say about it.

    Regions have scales of their own, so that a part with two of them has none.
    """
    if len(given) == 3:
        raise VolumeError("--spacing: write two numbers for 2D images, X,Y")
    inside = [region for region in source.regions.kept if part.common(region.part)]
    scales = {region.pixel_mm for region in inside}
    if len(scales) > 1:
        listed = ", or ".join(
            f"--crop {region.part} ({_millimetres(region.pixel_mm)})" for region in inside
        )
        return None, f"its ultrasound regions have different sizes of pixels: give {listed}"
    stated = next(iter(scales), None) or source.pixel_mm
    if stated and given:
        raise VolumeError(f"{path}: states the size of its pixels: leave out --spacing")
    if given:
        return (given[0], given[1]), ""
    if stated is None:
        return None, "its size of pixels is not stated: say it with --spacing X,Y (mm)"
    return stated, ""


def _millimetres(pixel: Scale | None) -> str:
    return f"{pixel[0]:.4g} × {pixel[1]:.4g} mm" if pixel else "of a size that is not stated"


def _result(source: Source, part: Rectangle, pixel: Scale | None) -> str:
    columns, rows = part.size
    count = source.shape[2]
    if source.placement is None:
        return f"{counted(count, 'image')} of {columns} × {rows} pixels {_millimetres(pixel)}"
    steps = np.linalg.norm(source.placement[:3, :3], axis=0) * 1e3
    apart = " × ".join(f"{step:.4g}" for step in steps)
    return f"a volume of {columns} × {rows} × {count} voxels of {apart} mm"


def _blanked(
    source: Source, settings: ImportSettings, shown: Sequence[Rectangle], undecided: str
) -> str:
    if undecided:
        return "nothing yet: it has to be said what is kept"
    said = []
    if settings.part is not None:
        said.append(f"all but columns and rows {settings.part} is cut off")
    if shown:
        others = source.regions.blanked
        said.append(
            f"everything outside the ultrasound regions {', '.join(map(str, shown))}"
            + (f", and {others} of other kinds" if others else "")
        )
    if said:
        return "; ".join(said)
    if settings.keep_whole_image:
        return "nothing (as was said)"
    return "nothing (volumes are not searched for text: look at the slices)"


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
