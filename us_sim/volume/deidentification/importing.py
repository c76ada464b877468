"""Files of scanners and other programs into a volume, a case or a sequence of images.

Only voxels, their place and time, and the values of `kept_values` go on. The source is read, the
rest is blanked, and the result is written anew: nothing is copied.

Burned-in text is detected, not read: thin strokes, brighter or darker than their surroundings, the
same in every image, of about one brightness, and beside one another on a line. Speckle has the
strokes, but neither the one brightness nor the line. It helps a person who looks at the picture,
and is no proof: it misses letters across bright tissue, handwriting, and faces.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
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
from us_sim.volume.files.dicom.header import dicom_files, is_dicom, packed_in
from us_sim.volume.files.readers import ENDINGS
from us_sim.volume.files.writing import write_image_sequence, write_volume
from us_sim.volume.volume import Volume

_STILL = 12  # grey levels by which the same letter differs between images; JPEG makes about ten
_STROKE = 11  # px, wider than the strokes of the largest letters
_HEIGHTS = (5, 60)  # px


@dataclass(frozen=True)
class _Glyphs:
    """Bright spots; each array has one number a spot."""

    left: NDArray[np.int64]
    top: NDArray[np.int64]
    right: NDArray[np.int64]  # the last column that belongs to it
    bottom: NDArray[np.int64]

    @property
    def height(self) -> NDArray[np.int64]:
        return self.bottom - self.top + 1


def find_text(images: Sequence[NDArray[np.uint8]]) -> list[Rectangle]:
    """Lines of possible text in images (rows, columns) of equal size, from the top down.

    Several, from all over a recording, tell text from moving echoes.
    """
    stack = np.stack(images)
    low, high = stack.min(axis=0), stack.max(axis=0)
    still = (high - low) <= _STILL
    # Grey levels; in three images or more hardly anything but text stands still.
    contrast = 45 if len(images) < 3 else 16
    lines = []
    # In a picture with few rows or columns letters may touch.
    for scale in (1, 2) if min(low.shape) <= 600 else (1,):
        for picture in (low, 255 - high):
            lines += _lines(_glyphs(picture, still, contrast, scale), scale)
    kept: list[Rectangle] = []  # each line once, where it was found at both scales
    for line in sorted(lines, key=lambda line: -line.size[0] * line.size[1]):
        x, y = (line.left + line.right) / 2, (line.top + line.bottom) / 2
        if not any(one.left <= x <= one.right and one.top <= y <= one.bottom for one in kept):
            kept.append(line)
    return sorted(kept, key=lambda line: (line.top, line.left))


def proposed_part(
    images: Sequence[NDArray[np.uint8]], text: Sequence[Rectangle]
) -> Rectangle | None:
    """The part of images (rows, columns) to keep, for a person to decide: the largest connected
    part that moves, or of one image that is not black; no places of possible text.
    """
    stack = np.stack(images)
    moving = np.ptp(stack, axis=0) > 16  # grey levels
    seen = moving if moving.mean() > 0.01 else stack.max(axis=0) > 8
    seen = seen.astype(np.uint8)
    for line in text:
        seen[line.slices] = 0
    opened = cv2.morphologyEx(seen, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8))
    count, _, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    if count < 2:
        return None
    left, top, width, height, _ = (
        int(each) for each in stats[1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))]
    )
    return Rectangle(left, top, left + width - 1, top + height - 1)


def _glyphs(
    picture: NDArray[np.uint8], still: NDArray[np.bool_], contrast: float, scale: int
) -> _Glyphs:
    """Strokes that stand out brightly, connected, and of a letter's size and evenness."""
    if scale > 1:
        size = (picture.shape[1] * scale, picture.shape[0] * scale)
        larger = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
        picture = np.asarray(larger, np.uint8)
        still = still.repeat(scale, axis=0).repeat(scale, axis=1)
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (_STROKE, _STROKE))
    stands_out = cv2.morphologyEx(picture, cv2.MORPH_TOPHAT, kernel)
    enough = np.maximum(0.5 * cv2.dilate(stands_out, kernel), contrast)
    strokes = ((stands_out > enough) & still).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(strokes, connectivity=8)
    left, top, width, height, area = stats.T.astype(np.int64)
    where = np.flatnonzero(strokes)
    flat, heights = labels.ravel()[where], stands_out.ravel()[where]
    brightest = np.zeros(count, np.int64)
    np.maximum.at(brightest, flat, heights)
    even = np.bincount(flat, heights >= 0.6 * brightest[flat], count) / area
    filled = area / (width * height)
    good = (_HEIGHTS[0] <= height) & (height <= _HEIGHTS[1]) & (width <= 2 * height)
    good &= (filled > 0.12) & ((filled < 0.9) | (width < 0.5 * height)) & (even > 0.5)
    good[0] = False  # the background of the strokes
    edges = (left, top, left + width - 1, top + height - 1)
    return _Glyphs(*(each[good] for each in edges))


def _lines(glyphs: _Glyphs, scale: int) -> list[Rectangle]:
    """Three glyphs or more of about one height, beside one another on a common base or top."""
    order = np.argsort(glyphs.left, kind="stable")
    groups = np.arange(len(order))
    for place, a in enumerate(order):
        reach = 1.3 * glyphs.height[a]
        for b in order[place + 1 :]:
            if glyphs.left[b] - glyphs.right[a] > reach:
                break  # those that begin further right are no nearer
            if _beside(glyphs, a, b):
                groups[groups == groups[b]] = groups[a]
    lines = []
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        if len(members) >= 3 and _is_line(glyphs, members):
            first = glyphs.left[members].min(), glyphs.top[members].min()
            last = glyphs.right[members].max(), glyphs.bottom[members].max()
            lines.append(Rectangle(*(int(edge) // scale for edge in (*first, *last))))
    return lines


def _beside(glyphs: _Glyphs, a: int, b: int) -> bool:
    low, high = sorted((int(glyphs.height[a]), int(glyphs.height[b])))
    between = glyphs.left[b] - glyphs.right[a]
    overlap = min(glyphs.bottom[a], glyphs.bottom[b]) - max(glyphs.top[a], glyphs.top[b])
    return bool(high <= 1.8 * low and -2 <= between <= high and overlap > 0.5 * low)


def _is_line(glyphs: _Glyphs, members: NDArray[np.int64]) -> bool:
    """Whether most stand on one base, or hang from one top, and the whole is wide."""
    height = float(np.median(glyphs.height[members]))
    slack = 1.0 + 0.08 * height
    width = glyphs.right[members].max() - glyphs.left[members].min()
    aligned = max(
        np.mean(np.abs(edge - np.median(edge)) <= slack)
        for edge in (glyphs.bottom[members], glyphs.top[members])
    )
    return bool(aligned >= 0.7 and width > 1.5 * height)


_MARGIN = 3  # pixels around text that are blanked with it: shadows and blurred edges
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
