"""Files of scanners and other programs into a volume or a case.

Only voxels and their place go on. The source is read, what lies outside its ultrasound
regions is blanked, and the result is written anew: nothing is copied. Text that is burned into what
is kept is not looked for.

A scanner writes names, dates and hospitals around the echoes. Where its header states ultrasound
regions, only the two-dimensional ones of tissue and flow (PS3.3, C.8.5.5) are kept: grey bars,
electrocardiograms, spectra and graphics are blanked with all that lies outside.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.errors import VolumeError
from us_sim.volume.deidentification.settings import ImportSettings, PixelRectangle
from us_sim.volume.files.dicom.header import (
    find_dicom_files,
    is_dicom,
    no_image_error,
    read_items,
    read_number,
    read_text,
)
from us_sim.volume.files.dicom.pixels import ImageFormat
from us_sim.volume.files.dicom.placed_images import open_images, place_images
from us_sim.volume.files.labels import refuse_segments
from us_sim.volume.files.readers import ENDINGS, open_image
from us_sim.volume.files.stored_image import read_grey_voxels, stack_slices
from us_sim.volume.files.writing import VOLUME_ENDINGS, explain_volume_ending, write_volume
from us_sim.volume.partial_file import partial_file
from us_sim.volume.volume import Volume


@dataclass(frozen=True, eq=False)
class ImageSource:
    """Images of one volume, as they come."""

    shape: tuple[int, int, int]  # columns, rows, images
    # (rows, columns) one after another; those pixels of each that are not kept are 0
    images: Callable[[NDArray[np.bool_] | None], Iterator[NDArray[np.uint8]]]
    conversions: tuple[str, ...]  # of the stored values
    placement: NDArray[np.float64]  # (4, 4) m, from (column, row, image)
    regions: Sequence[PixelRectangle] = ()  # of echoes, as the header says
    doubt: str = ""  # why it states none, of images that may show a name outside them


@dataclass(frozen=True, eq=False)
class ImportPlan:
    """Files that were looked at, and the result that is planned."""

    path: Path  # the first of them
    out: Path | None
    source: ImageSource
    part: PixelRectangle  # of every image that is cut out
    regions: tuple[PixelRectangle, ...]  # all else in it becomes black; none: nothing does
    undecided: str = ""  # what a person has to say before anything can be written

    @property
    def summary(self) -> str:
        """A sentence on what is made and blanked, and what nobody looked at."""
        columns, rows, count = (*self.part.size, self.source.shape[2])
        steps = np.linalg.norm(self.source.placement[:3, :3], axis=0) * 1e3
        apart = " × ".join(f"{step:.4g}" for step in steps)
        said = [f"a volume of {columns} × {rows} × {count} voxels of {apart} mm"]
        if self.part.size != self.source.shape[:2]:
            said.append(f"all but columns and rows {self.part} is cut off")
        if self.regions:
            listed = ", ".join(map(str, self.regions))
            said.append(f"everything outside the ultrasound regions {listed} is black")
        said += [*self.source.conversions, "all of the header but the place is dropped"]
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
        """Write the result: a volume, or a case where the name has no ending.

        Raises:
            VolumeError: a person has to say first which part of the images is kept; or they cannot
                be read, or the result not written.
            CaseError: the case cannot be made.
        """
        assert self.out is not None
        if self.undecided:
            raise VolumeError(f"{self.path}: {self.undecided}")
        out, (columns, rows), count = self.out, self.part.size, self.source.shape[2]
        if min(columns, rows) < 2:
            raise VolumeError(f"--crop {self.part}: a volume needs two columns and rows or more")
        placement = self.source.placement.copy()
        placement[:, 3] = placement @ [self.part.left, self.part.top, 0.0, 1.0]
        volume = Volume(stack_slices(self._images(progress), count), placement)
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


def plan_import(
    files: Sequence[str | os.PathLike[str]], out: Path | None, settings: ImportSettings
) -> ImportPlan:
    """Plan an import, and write nothing.

    Args:
        files: DICOM files of one series, or a folder of them; or one MetaImage, NRRD or NIfTI
            volume.
        out: a new case's folder, or a file with a volume's ending; None where nothing will be
            written.
        settings: which part is kept.

    Raises:
        VolumeError: a file cannot be read, the files are no volume, or there is something at
            ``out`` already.
    """
    paths: list[Path] = []
    for each in map(Path, files):
        if not each.exists():
            raise VolumeError(f"{each}: there is no such file")
        paths += find_dicom_files(each) if each.is_dir() else [each]
    if out is not None and os.path.lexists(out):
        raise VolumeError(f"{out}: exists already; choose another name, or remove it")
    if out is not None and (problem := explain_volume_ending(out)):
        raise VolumeError(problem)
    path, source = paths[0], _source(paths, settings)
    columns, rows, _ = source.shape
    whole = PixelRectangle(0, 0, columns - 1, rows - 1)
    part = settings.part or whole
    if part.intersect(whole) != part:
        raise VolumeError(f"--crop {part}: is larger than the images, which are {whole}")
    regions = () if settings.keep_whole_image else source.regions
    shown = tuple(filter(None, map(part.intersect, regions)))
    if regions and not shown:
        raise VolumeError(
            f"--crop {part}: shows nothing of the ultrasound regions "
            f"{', '.join(map(str, regions))}; keep a part of these, or give "
            f"--keep-whole-image with it if there is nothing to hide"
        )
    undecided = ""
    if source.doubt and not (settings.part or settings.keep_whole_image):
        undecided = (
            f"names and dates may be burned into its images, and nothing says which part of them "
            f"holds echoes ({source.doubt}); look at it with --picture FILE, then give "
            f"--crop X0,Y0,X1,Y1, or --keep-whole-image if there is nothing to hide"
        )
    return ImportPlan(path, out, source, part, shown, undecided)


def _source(paths: list[Path], settings: ImportSettings) -> ImageSource:
    """Open one MetaImage, NRRD or NIfTI volume, whose images are the slices, or DICOM files."""
    spacing = settings.spacing_mm
    others = [path for path in paths if path.name.lower().endswith(ENDINGS)]
    if len(paths) == 1 and others:
        image = open_image(paths[0], layers=True)
        refuse_segments(paths[0], image.texts)
        image.require_volume()
        placement = image.placement(spacing or None)
        voxels, said = read_grey_voxels(image, settings.volume)
        return ImageSource(image.shape, lambda _: iter(voxels.transpose(2, 1, 0)), said, placement)
    if strange := [*others, *(path for path in paths if not is_dicom(path))]:
        raise no_image_error(
            strange[0],
            "is no DICOM file; give DICOM files of one series, or one MHA, NRRD or NIfTI volume",
        )
    return _of_dicom(paths, settings.volume, spacing)


def _of_dicom(paths: Sequence[Path], volume: int, spacing: tuple[float, ...]) -> ImageSource:
    """Open the images of DICOM files of one series."""
    images = open_images(paths)
    placed = place_images(images, volume, spacing)
    conversions = list(images.conversions)
    if placed.volumes > 1:
        conversions.append(f"volume {volume} of {placed.volumes} in time")
    regions, doubt = _ultrasound_regions(images.files[0], images.form)
    if any(_ultrasound_regions(file, images.form)[0] != regions for file in images.files):
        regions, doubt = [], "the files have different ultrasound regions"
    burned = any(read_text(file, "BurnedInAnnotation") == "YES" for file in images.files)
    return ImageSource(
        (images.form.columns, images.form.rows, len(placed.which)),
        lambda keep: images.read_images(placed.which, keep),
        tuple(conversions),
        placed.placement,
        regions,
        doubt if burned else "",
    )


def _ultrasound_regions(header: Any, form: ImageFormat) -> tuple[list[PixelRectangle], str]:
    """Return the regions of echoes; none, with the reason, if one of the header's cannot be."""
    kept = []
    for region in read_items(header, "SequenceOfUltrasoundRegions"):
        keys = ("MinX0", "MinY0", "MaxX1", "MaxY1")
        found = [read_number(region, f"RegionLocation{key}") for key in keys]
        edges = [-1 if each is None else int(each) for each in found]
        # Some scanners write the first column beyond a region as its last.
        ends = (form.columns - 1, form.rows - 1)
        part = PixelRectangle(edges[0], edges[1], *map(min, edges[2:], ends))
        is_within = edges[2] <= form.columns and edges[3] <= form.rows
        if min(edges) < 0 or min(part.size) < 1 or not is_within:
            doubt = f"a region is {edges} in an image of {form.columns} × {form.rows} pixels"
            return [], doubt
        kinds = read_number(region, "RegionSpatialFormat"), read_number(region, "RegionDataType")
        if kinds in ((1, 1), (1, 2)):  # two-dimensional, of tissue or of colour flow
            kept.append(part)
    return kept, "" if kept else "there is no ultrasound region of tissue or flow"
