"""Files of scanners and other programs into a volume, a case or a sequence of images.

Only voxels, and their place and time, go on. The source is read, what lies outside its ultrasound
regions is blanked, and the result is written anew: nothing is copied. Text that is burned into what
is kept is not looked for.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
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
from us_sim.volume.partial_file import partial_file
from us_sim.volume.volume import Volume

_VOLUMES = (".nrrd", ".mha", ".nii", ".nii.gz")


@dataclass(frozen=True, eq=False)
class Import:
    """Files that were looked at, and the result that is planned."""

    paths: list[Path]
    out: Path | None
    settings: ImportSettings
    source: Source
    parts: tuple[Rectangle, ...]  # of every image, those that are kept; none: all of it
    regions: tuple[Rectangle, ...]  # those of them that are ultrasound regions
    pixel_mm: Scale | None  # of images without a place
    undecided: str = ""  # what a person has to say before anything can be written

    @property
    def what(self) -> str:
        """The result, with its size, for a person."""
        source, count = self.source, self.source.shape[2]
        columns, rows = self.settings.part.size if self.settings.part else source.shape[:2]
        if source.placement is None:
            size = f"{columns} × {rows} pixels {_millimetres(self.pixel_mm)}"
            return f"{counted(count, 'image')} of {size}"
        steps = np.linalg.norm(source.placement[:3, :3], axis=0) * 1e3
        apart = " × ".join(f"{step:.4g}" for step in steps)
        return f"a volume of {columns} × {rows} × {count} voxels of {apart} mm"

    @property
    def said(self) -> str:
        """What is made and blanked, and what nobody looked at, for a person."""
        said = [self.what]
        if self.settings.part:
            said.append(f"all but columns and rows {self.settings.part} is cut off")
        if self.regions:
            listed = ", ".join(map(str, self.regions))
            said.append(f"everything outside the ultrasound regions {listed} is black")
        said += [*self.source.conversions, "all of the header but place and time is dropped"]
        if self.undecided:
            said.append(f"NOTHING CAN BE WRITTEN YET: {self.undecided}")
        said.append("TEXT THAT IS BURNED INTO WHAT IS KEPT WAS NOT LOOKED FOR: look at the images")
        return "; ".join(said)

    def draw(self, file: Path) -> None:
        """Write the first image as it was, with boxes around its kept parts, as a PNG.

        It may show a name: it belongs where the original is kept.
        """
        picture = np.asarray(cv2.cvtColor(self.source.first, cv2.COLOR_GRAY2BGR), np.uint8)
        for box in self.parts:
            cv2.rectangle(picture, box[:2], box[2:], (80, 220, 80), 1)
        with partial_file(file) as partial:
            partial.touch(0o600)  # the owner's alone
            partial.write_bytes(cv2.imencode(".png", picture)[1].tobytes())

    def write(self, progress: Progress | None = None) -> None:
        """Write the result.

        Raises:
            VolumeError: a person has to say first which part of the images is kept; or they cannot
                be read, or the result not written.
            CaseError: the case cannot be made.
        """
        assert self.out is not None
        if self.undecided:
            raise VolumeError(f"{self.paths[0]}: {self.undecided}")
        if self.source.placement is None:
            self._write_images(self.out, progress)
        else:
            self._write_volume(self.out, self.source.placement, progress)

    @property
    def _keep(self) -> NDArray[np.bool_] | None:
        """(rows, columns) of every image; None: all of it, since it is cut later."""
        if not self.regions:
            return None
        keep = np.zeros(self.source.shape[1::-1], bool)
        for part in self.regions:
            keep[part.slices] = True
        return keep

    def _write_images(self, out: Path, progress: Progress | None) -> None:
        """Write images without a place, one after another in time."""
        source, part = self.source, self.settings.part
        assert self.pixel_mm is not None
        columns, rows, count = source.shape
        part = part or Rectangle(0, 0, columns - 1, rows - 1)

        def images() -> Iterator[NDArray[np.uint8]]:
            assert source.images is not None
            for number, image in enumerate(source.images(self._keep), start=1):
                yield image[part.slices]
                if progress:
                    progress(number / count, f"{number} of {count} images")

        shape = (count, *part.size[::-1])
        write_image_sequence(out, images(), shape, source.times, self.pixel_mm)

    def _write_volume(
        self, out: Path, placement: NDArray[np.float64], progress: Progress | None
    ) -> None:
        """Write a volume as a file, or as a new case where the name has no ending."""
        source, settings = self.source, self.settings
        assert source.voxels is not None
        volume = _cropped(source.voxels(self._keep, progress), placement, settings.part)
        if out.name.lower().endswith(_VOLUMES):
            write_volume(out, volume)
            return
        from us_sim.volume.cases.settings import CaseSettings
        from us_sim.volume.cases.writing import new_case, write_case_settings

        with new_case(out) as folder:
            write_volume(folder / "volume.nrrd", volume)
            del volume  # it is read again at the end, to propose where to start
            write_case_settings(folder, CaseSettings(name=settings.name or out.name))


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
        if not each.exists():
            raise VolumeError(f"{each}: there is no such file")
        paths += dicom_files(each) if each.is_dir() else [each]
    if out is not None and os.path.lexists(out):
        raise VolumeError(f"{out}: exists already; choose another name, or remove it")
    if out and out.suffix and not out.name.lower().endswith(_VOLUMES) and len(out.suffix) <= 5:
        raise VolumeError(
            f"{out}: its name ends as no volume's does; write {', '.join(_VOLUMES)}, .igs.mha for "
            f"2D images, or a folder's name without an ending for a case"
        )
    return _planned(paths, out, settings, _source(paths, out, settings))


def _source(paths: list[Path], out: Path | None, settings: ImportSettings) -> Source:
    spacing = settings.spacing_mm
    others = [path for path in paths if path.name.lower().endswith(ENDINGS)]
    if len(paths) == 1 and others:
        if len(spacing) == 2:
            raise VolumeError("--spacing: write three numbers for a volume: X,Y,Z")
        return file_source(paths[0], settings.volume, spacing or None)
    if strange := [*others, *(path for path in paths if not is_dicom(path))]:
        raise refuse_other(
            strange[0],
            "is no DICOM file; give DICOM files of one series, or one MHA, NRRD or NIfTI volume",
        )
    needs_volume = out is not None and not out.name.lower().endswith(".mha")
    return dicom_source(paths, settings.volume, spacing, needs_volume=needs_volume)


def _planned(
    paths: list[Path], out: Path | None, settings: ImportSettings, source: Source
) -> Import:
    """Find out what of every image is kept, and its scale."""
    columns, rows, _ = source.shape
    whole = Rectangle(0, 0, columns - 1, rows - 1)
    part = settings.part or whole
    if part.common(whole) != part:
        raise VolumeError(f"--crop {part}: is larger than the images, which are {whole}")
    regions = () if settings.keep_whole_image else source.regions
    shown = tuple(filter(None, (part.common(region.part) for region in regions)))
    if regions and not shown:
        raise VolumeError(
            f"--crop {part}: shows nothing of the ultrasound regions "
            f"{', '.join(str(region.part) for region in regions)}; keep a part of these, or give "
            f"--keep-whole-image with it if there is nothing to hide"
        )
    undecided = []
    if source.needs_part and not (regions or settings.part or settings.keep_whole_image):
        undecided.append(
            f"names and dates may be burned into its images, and nothing says which part of them "
            f"holds echoes ({source.doubt}); look at it with --picture FILE, then give "
            f"--crop X0,Y0,X1,Y1, or --keep-whole-image if there is nothing to hide"
        )
    pixel: Scale | None = None
    if source.placement is None:
        try:
            pixel = _scale(paths[0], source, part, settings.spacing_mm)
        except ValueError as unknown:
            undecided.append(str(unknown))
    parts = shown or ((part,) if settings.part else ())
    return Import(paths, out, settings, source, parts, shown, pixel, "; ".join(undecided))


def _scale(path: Path, source: Source, part: Rectangle, given: tuple[float, ...]) -> Scale:
    """Return the size of pixels in a part of an image, mm.

    Regions have scales of their own, so that a part with two of them has none.

    Raises:
        ValueError: a person has to say it first, and how.
        VolumeError: it is stated, and given as well.
    """
    if len(given) == 3:
        raise VolumeError("--spacing: write two numbers for 2D images, X,Y")
    inside = [region for region in source.regions if part.common(region.part)]
    scales = {region.pixel_mm for region in inside}
    if len(scales) > 1:
        each = (f"--crop {region.part} ({_millimetres(region.pixel_mm)})" for region in inside)
        raise ValueError(f"its regions have different sizes of pixels: give {', or '.join(each)}")
    stated = next(iter(scales), None) or source.pixel_mm
    if stated and given:
        raise VolumeError(f"{path}: states the size of its pixels: leave out --spacing")
    if not (stated or given):
        raise ValueError("its size of pixels is not stated: say it with --spacing X,Y (mm)")
    return stated or (given[0], given[1])


def _millimetres(pixel: Scale | None) -> str:
    return f"{pixel[0]:.4g} × {pixel[1]:.4g} mm" if pixel else "of a size that is not stated"


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
