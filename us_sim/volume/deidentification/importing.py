"""Files of scanners and other programs into a volume, a case or a sequence of images.

Only voxels, and their place and time, go on. The source is read, what lies outside its ultrasound
regions is blanked, and the result is written anew: nothing is copied. Text that is burned into what
is kept is not looked for.

A scanner writes names, dates and hospitals around the echoes. Of its 2D images only the
two-dimensional ultrasound regions of tissue and flow (PS3.3, C.8.5.5) are kept: grey bars,
electrocardiograms, spectra and graphics are blanked with all that lies outside. Each region has a
scale of its own.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.spelling import counted
from us_sim.volume.deidentification.settings import ImportSettings, Rectangle
from us_sim.volume.files.dicom.header import (
    dicom_files,
    groups_of,
    is_dicom,
    items,
    number,
    numbers,
    refuse_other,
    text,
)
from us_sim.volume.files.dicom.pixels import ImageFormat
from us_sim.volume.files.dicom.placed_images import (
    frame_times,
    is_flat,
    opened_images,
    placed_images,
)
from us_sim.volume.files.labels import refuse_segments
from us_sim.volume.files.readers import ENDINGS, open_image
from us_sim.volume.files.stored_image import grey_voxels, volume_of_slices
from us_sim.volume.files.writing import VOLUME_ENDINGS, write_image_sequence, write_volume
from us_sim.volume.partial_file import partial_file
from us_sim.volume.volume import Volume

Progress = Callable[[float, str], None]
Scale = tuple[float, float]  # mm, width and height of a pixel


@dataclass(frozen=True, eq=False)
class Source:
    """Images of one volume or of one recording, as they come."""

    shape: tuple[int, int, int]  # columns, rows, images
    # (rows, columns) one after another; those pixels of each that are not kept are 0
    images: Callable[[NDArray[np.bool_] | None], Iterator[NDArray[np.uint8]]]
    conversions: tuple[str, ...]  # of the stored values
    placement: NDArray[np.float64] | None  # (4, 4) m, from (column, row, image); None: no volume
    # of echoes, as the header says, with the size of their pixels where it is stated
    regions: Mapping[Rectangle, Scale | None] = field(default_factory=dict)
    doubt: str = ""  # why it states none, of images that may show a name outside them
    times: Sequence[float] = ()  # s, of images that are no volume
    pixel_mm: Scale | None = None  # of all of an image, where it is stated


@dataclass(frozen=True, eq=False)
class Import:
    """Files that were looked at, and the result that is planned."""

    path: Path  # the first of them
    out: Path | None
    source: Source
    part: Rectangle  # of every image that is cut out
    regions: tuple[Rectangle, ...]  # all else in it becomes black; none: nothing does
    pixel_mm: Scale | None  # of images without a place
    undecided: str = ""  # what a person has to say before anything can be written

    @property
    def said(self) -> str:
        """What is made and blanked, and what nobody looked at, for a person."""
        columns, rows, count = (*self.part.size, self.source.shape[2])
        if self.source.placement is None:
            size = f"{columns} × {rows} pixels {_millimetres(self.pixel_mm)}"
            said = [f"{counted(count, 'image')} of {size}"]
        else:
            steps = np.linalg.norm(self.source.placement[:3, :3], axis=0) * 1e3
            apart = " × ".join(f"{step:.4g}" for step in steps)
            said = [f"a volume of {columns} × {rows} × {count} voxels of {apart} mm"]
        if self.part.size != self.source.shape[:2]:
            said.append(f"all but columns and rows {self.part} is cut off")
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
        first = next(self.source.images(None))
        picture = np.asarray(cv2.cvtColor(first, cv2.COLOR_GRAY2BGR), np.uint8)
        for box in self.regions or (self.part,):
            cv2.rectangle(picture, box[:2], box[2:], (80, 220, 80), 1)
        with partial_file(file) as partial:
            partial.touch(0o600)  # the owner's alone
            partial.write_bytes(cv2.imencode(".png", picture)[1].tobytes())

    def write(self, progress: Progress | None = None) -> None:
        """Write the result: a sequence of images, a volume, or a case where the name has no ending.

        Raises:
            VolumeError: a person has to say first which part of the images is kept; or they cannot
                be read, or the result not written.
            CaseError: the case cannot be made.
        """
        assert self.out is not None
        if self.undecided:
            raise VolumeError(f"{self.path}: {self.undecided}")
        out, (columns, rows), count = self.out, self.part.size, self.source.shape[2]
        if self.source.placement is None:
            assert self.pixel_mm is not None
            shape = (count, rows, columns)
            images = self._images(progress)
            write_image_sequence(out, images, shape, self.source.times, self.pixel_mm)
            return
        if min(columns, rows) < 2:
            raise VolumeError(f"--crop {self.part}: a volume needs two columns and rows or more")
        placement = self.source.placement.copy()
        placement[:, 3] = placement @ [self.part.left, self.part.top, 0.0, 1.0]
        volume = Volume(volume_of_slices(self._images(progress), count), placement)
        if out.name.lower().endswith(VOLUME_ENDINGS):
            write_volume(out, volume)
            return
        from us_sim.volume.cases.settings import CaseSettings
        from us_sim.volume.cases.writing import new_case, write_case_settings

        with new_case(out) as folder:
            write_volume(folder / "volume.nrrd", volume)
            del volume  # it is read again at the end, to propose where to start
            write_case_settings(folder, CaseSettings(name=out.name))

    def _images(self, progress: Progress | None) -> Iterator[NDArray[np.uint8]]:
        """Yield what is kept of each image."""
        keep = None
        if self.regions:
            keep = np.zeros(self.source.shape[1::-1], bool)
            for region in self.regions:
                keep[region.slices] = True
        count = self.source.shape[2]
        for done, image in enumerate(self.source.images(keep), start=1):
            yield image[self.part.slices]
            if progress:
                progress(done / count, f"{done} of {count} images")


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
    if out and 1 < len(out.suffix) <= 5 and not out.name.lower().endswith(VOLUME_ENDINGS):
        raise VolumeError(
            f"{out}: its name ends as no volume's does; write {', '.join(VOLUME_ENDINGS)}, "
            f".igs.mha for 2D images, or a folder's name without an ending for a case"
        )
    path, source = paths[0], _source(paths, out, settings)
    columns, rows, _ = source.shape
    whole = Rectangle(0, 0, columns - 1, rows - 1)
    part = settings.part or whole
    if part.common(whole) != part:
        raise VolumeError(f"--crop {part}: is larger than the images, which are {whole}")
    regions = {} if settings.keep_whole_image else source.regions
    shown = tuple(filter(None, map(part.common, regions)))
    if regions and not shown:
        raise VolumeError(
            f"--crop {part}: shows nothing of the ultrasound regions "
            f"{', '.join(map(str, regions))}; keep a part of these, or give "
            f"--keep-whole-image with it if there is nothing to hide"
        )
    undecided = []
    if source.doubt and not (settings.part or settings.keep_whole_image):
        undecided.append(
            f"names and dates may be burned into its images, and nothing says which part of them "
            f"holds echoes ({source.doubt}); look at it with --picture FILE, then give "
            f"--crop X0,Y0,X1,Y1, or --keep-whole-image if there is nothing to hide"
        )
    pixel: Scale | None = None
    if source.placement is None:
        try:
            pixel = _scale(path, source, part, settings.spacing_mm)
        except ValueError as unknown:
            undecided.append(str(unknown))
    return Import(path, out, source, part, shown, pixel, "; ".join(undecided))


def _scale(path: Path, source: Source, part: Rectangle, given: tuple[float, ...]) -> Scale:
    """Return the size of pixels in a part of an image, mm.

    Regions have scales of their own, so that a part with two of them has none.

    Raises:
        ValueError: a person has to say it first, and how.
        VolumeError: it is stated, and given as well.
    """
    if len(given) == 3:
        raise VolumeError("--spacing: write two numbers for 2D images, X,Y")
    inside = {region: size for region, size in source.regions.items() if part.common(region)}
    scales = set(inside.values())
    if len(scales) > 1:
        each = (f"--crop {region} ({_millimetres(size)})" for region, size in inside.items())
        raise ValueError(f"its regions have different sizes of pixels: give {', or '.join(each)}")
    stated = next(iter(scales), None) or source.pixel_mm
    if stated and given:
        raise VolumeError(f"{path}: states the size of its pixels: leave out --spacing")
    if not (stated or given):
        raise ValueError("its size of pixels is not stated: say it with --spacing X,Y (mm)")
    return stated or (given[0], given[1])


def _millimetres(pixel: Scale | None) -> str:
    return f"{pixel[0]:.4g} × {pixel[1]:.4g} mm" if pixel else "of a size that is not stated"


def _source(paths: list[Path], out: Path | None, settings: ImportSettings) -> Source:
    """Open one MetaImage, NRRD or NIfTI volume, whose images are the slices, or DICOM files."""
    spacing = settings.spacing_mm
    others = [path for path in paths if path.name.lower().endswith(ENDINGS)]
    if len(paths) == 1 and others:
        if len(spacing) == 2:
            raise VolumeError("--spacing: write three numbers for a volume: X,Y,Z")
        image = open_image(paths[0], layers=True)
        refuse_segments(paths[0], image.texts)
        image.check()
        placement = image.placement(spacing or None)
        voxels, said = grey_voxels(image, settings.volume)
        return Source(image.shape, lambda _: iter(voxels.transpose(2, 1, 0)), said, placement)
    if strange := [*others, *(path for path in paths if not is_dicom(path))]:
        raise refuse_other(
            strange[0],
            "is no DICOM file; give DICOM files of one series, or one MHA, NRRD or NIfTI volume",
        )
    needs_volume = out is not None and not out.name.lower().endswith(".mha")
    return _of_dicom(paths, settings.volume, spacing, needs_volume=needs_volume)


def _of_dicom(
    paths: Sequence[Path], volume: int, spacing: tuple[float, ...], *, needs_volume: bool
) -> Source:
    """Open the images of DICOM files of one series; refuse flat ones where a volume is needed."""
    images = opened_images(paths)
    first = images.files[0]
    is_volume = needs_volume or not is_flat(images, spacing)
    placed = placed_images(images, volume, spacing) if is_volume else None
    if placed is None and len(paths) > 1:
        raise VolumeError(f"{paths[0]}: and the other files are no volume; import each by itself")
    which = placed.which if placed else images.all
    conversions = list(images.conversions)
    times = frame_times(first, images.form.frames)
    if placed is None and times is None:
        conversions.append("times of images are not stated: one every 40 ms is assumed")
    if placed is not None and placed.volumes > 1:
        conversions.append(f"volume {volume} of {placed.volumes} in time")
    regions, doubt = _ultrasound_regions(first, images.form)
    if any(_ultrasound_regions(file, images.form)[0] != regions for file in images.files):
        regions, doubt = {}, "the files have different ultrasound regions"
    burned = any(text(file, "BurnedInAnnotation") == "YES" for file in images.files)
    return Source(
        (images.form.columns, images.form.rows, len(which)),
        lambda keep: images.images(which, keep),
        tuple(conversions),
        placed.placement if placed else None,
        regions,
        doubt if placed is None or burned else "",
        [n * 0.04 for n in range(len(which))] if times is None else times,
        _stated_scale(first),
    )


def _ultrasound_regions(
    header: Any, form: ImageFormat
) -> tuple[dict[Rectangle, Scale | None], str]:
    """Return the regions of echoes; none, with the reason, if one of the header's cannot be."""
    kept = {}
    for region in items(header, "SequenceOfUltrasoundRegions"):
        keys = ("MinX0", "MinY0", "MaxX1", "MaxY1")
        found = [number(region, f"RegionLocation{key}") for key in keys]
        edges = [-1 if each is None else int(each) for each in found]
        # Some scanners write the first column beyond a region as its last.
        ends = (form.columns - 1, form.rows - 1)
        part = Rectangle(edges[0], edges[1], *map(min, edges[2:], ends))
        is_within = edges[2] <= form.columns and edges[3] <= form.rows
        if min(edges) < 0 or min(part.size) < 1 or not is_within:
            doubt = f"a region is {edges} in an image of {form.columns} × {form.rows} pixels"
            return {}, doubt
        kinds = number(region, "RegionSpatialFormat"), number(region, "RegionDataType")
        if kinds in ((1, 1), (1, 2)):  # two-dimensional, of tissue or of colour flow
            kept[part] = _region_scale(region)
    return kept, "" if kept else "there is no ultrasound region of tissue or flow"


def _region_scale(region: Any) -> Scale | None:
    units = number(region, "PhysicalUnitsXDirection"), number(region, "PhysicalUnitsYDirection")
    x, y = number(region, "PhysicalDeltaX"), number(region, "PhysicalDeltaY")
    if units != (3, 3) or not x or not y:  # centimetres
        return None
    return float(f"{abs(x) * 10.0:.7g}"), float(f"{abs(y) * 10.0:.7g}")


def _stated_scale(header: Any) -> Scale | None:
    """Read `PixelSpacing`, or its counterpart in secondary captures."""
    groups = groups_of(header, int(number(header, "NumberOfFrames") or 1))[0]
    measures = (each for group in groups for each in items(group, "PixelMeasuresSequence"))
    for source in (header, *measures):
        # Between rows, then between columns (PS3.3, 10.7.1.3).
        for key in ("PixelSpacing", "NominalScannedPixelSpacing"):
            stated = numbers(source, key, 2)
            if stated and all(1e-4 <= each <= 100.0 for each in stated):
                return stated[1], stated[0]
    return None
