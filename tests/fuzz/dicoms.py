"""DICOM files: volumes, recordings, palettes, deflated and compressed images, and their import."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydicom.uid import ExplicitVRBigEndian, ImplicitVRLittleEndian, JPEG2000Lossless, RLELossless

from tests.fuzz.target import target
from tests.volume.files.dicom.made_dicom import (
    LIVER,
    SEGMENTED,
    US_IMAGE,
    US_MULTI_FRAME,
    compressed,
    enhanced,
    header,
    item,
    segmentation,
    turned,
    write,
)
from us_sim.volume.deidentification.importing import import_files
from us_sim.volume.deidentification.settings import ImportSettings
from us_sim.volume.files.dicom.placed_images import placed_images
from us_sim.volume.files.labels import read_labels
from us_sim.volume.volume import Volume

VOXELS = np.arange(7 * 6 * 5, dtype=np.uint8).reshape(7, 6, 5)
LABELLED = Volume(np.zeros(LIVER.shape, np.uint8), SEGMENTED)
CINE = np.arange(4 * 12 * 10, dtype=np.uint8).reshape(4, 12, 10)


def volume_seeds(folder: Path) -> Iterator[bytes]:
    """Enhanced volumes in several syntaxes and types, with several times, and a legacy one."""
    placed = turned()
    file = folder / "volume.dcm"
    yield write(file, enhanced(VOXELS, placed)).read_bytes()
    yield write(file, enhanced(VOXELS.astype(np.int16), placed, times=2)).read_bytes()
    yield write(file, enhanced(VOXELS, placed), ImplicitVRLittleEndian).read_bytes()
    yield write(file, enhanced(VOXELS, placed), deflated=True).read_bytes()
    legacy = header(VOXELS.transpose(2, 1, 0).copy(), US_MULTI_FRAME)
    legacy.PixelSpacing, legacy.SpacingBetweenSlices = [0.5, 0.25], 2.0
    yield write(file, legacy).read_bytes()


@target("dicom", ".dcm", volume_seeds)
def volume(path: Path) -> None:
    """The voxels, and where they are."""
    placed = placed_images([path])
    columns, rows = placed.images.form.columns, placed.images.form.rows
    assert placed.voxels().shape == (columns, rows, len(placed.which))
    assert np.isfinite(placed.placement).all()


def cine_seeds(folder: Path) -> Iterator[bytes]:
    """Images that are no volume: with regions, in colour, with a palette, compressed."""
    file = folder / "cine.dcm"
    grey = header(CINE, US_MULTI_FRAME, FrameTime=40.0, FrameIncrementPointer=0x00181063)
    region = {"RegionSpatialFormat": 1, "RegionDataType": 1, "RegionFlags": 0}
    edges = {"MinX0": 2, "MinY0": 3, "MaxX1": 8, "MaxY1": 10}
    region |= {f"RegionLocation{key}": value for key, value in edges.items()}
    region |= {"PhysicalUnitsXDirection": 3, "PhysicalUnitsYDirection": 3}
    region |= {"PhysicalDeltaX": 0.05, "PhysicalDeltaY": 0.05}
    grey.SequenceOfUltrasoundRegions = [item(**region)]
    yield write(file, grey).read_bytes()
    yield write(file, grey, ExplicitVRBigEndian).read_bytes()
    colour = header(np.repeat(CINE[..., None], 3, axis=3), US_MULTI_FRAME)
    colour.PixelSpacing = [0.5, 0.5]
    yield write(file, colour).read_bytes()
    palette = header(CINE[:1] % 4, US_IMAGE, PhotometricInterpretation="PALETTE COLOR")
    palette.PixelSpacing = [0.5, 0.5]
    for name in ("Red", "Green", "Blue"):
        setattr(palette, f"{name}PaletteColorLookupTableDescriptor", [4, 0, 16])
        table = np.array([0, 20000, 40000, 65535], "<u2").tobytes()
        setattr(palette, f"{name}PaletteColorLookupTableData", table)
    yield write(file, palette).read_bytes()
    yield write(file, compressed(grey, RLELossless), RLELossless).read_bytes()
    yield write(file, compressed(grey, JPEG2000Lossless), JPEG2000Lossless).read_bytes()


@target("dicom-import", ".dcm", cine_seeds)
def cine(path: Path) -> None:
    """An import; the file that it writes is there, or nothing is."""
    out = path.with_name(f"{path.stem}.igs.mha")
    try:
        import_files([path], out, ImportSettings(keep_whole_image=True))
    except BaseException:
        assert not out.exists()
        raise
    assert out.stat().st_size > 0


def segmentation_seeds(folder: Path) -> Iterator[bytes]:
    """Masks of one bit, fractions, and a label map."""
    for kind in ("BINARY", "FRACTIONAL", "LABELMAP"):
        yield segmentation(folder / "labels.dcm", kind).read_bytes()


@target("dicom-labels", ".dcm", segmentation_seeds)
def labels(path: Path) -> None:
    """Labels on a volume's grid, each with a name."""
    read = read_labels(path, LABELLED, resample=True)
    assert read.labels.shape == LABELLED.shape
    assert set(np.unique(read.labels)) - {0} <= set(read.names)
