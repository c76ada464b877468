"""Files of labels, tables of labels, and files of seeds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from tests.fuzz.target import target
from us_sim.volume.files.labels import read_label_table, read_labels
from us_sim.volume.segmentation.settings import read_seeds
from us_sim.volume.segmentation.structures import segment
from us_sim.volume.volume import Volume

GREY = np.full((8, 7, 6), 90, np.uint8)
GREY[2:6, 2:5, 1:5] = 10
LIKE = Volume(GREY, np.diag([1e-3, 1e-3, 1e-3, 1.0]))


def label_seeds(folder: Path) -> Iterator[bytes]:
    """Segmentations of one layer and of two, packed and not, and plain labels."""
    labels = np.where(GREY.transpose(2, 1, 0) < 50, 3, 0).astype(np.uint8)
    layers = np.stack([labels, (labels[::-1] > 0).astype(np.uint8)], axis=-1)
    for values in (labels, layers, labels.astype(np.int16)):
        for packed in (False, True):
            image = sitk.GetImageFromArray(values, isVector=values.ndim == 4)
            if values.dtype == np.uint8:
                image.SetMetaData("Segmentation_MasterRepresentation", "Binary labelmap")
                for number, (name, value) in enumerate((("portal vein", 3), ("bone", 1))):
                    image.SetMetaData(f"Segment{number}_Name", name)
                    image.SetMetaData(f"Segment{number}_LabelValue", str(value))
                    image.SetMetaData(f"Segment{number}_Layer", str(min(number, values.ndim - 3)))
                    image.SetMetaData(f"Segment{number}_Color", "0.2 0.4 1")
                    image.SetMetaData(f"Segment{number}_Extent", "0 7 0 6 0 5")
            file = folder / "labels.seg.nrrd"
            sitk.WriteImage(image, str(file), packed)
            yield file.read_bytes()


@target("labels", ".seg.nrrd", label_seeds)
def labels(path: Path) -> None:
    """Labels on the grid of the volume, each with a name and a colour."""
    read = read_labels(path, LIKE, resample=True)
    assert read.labels.shape == LIKE.shape
    assert set(np.unique(read.labels)) - {0} == set(read.names)
    assert set(read.colours) >= set(read.names)


def table_seeds(_: Path) -> Iterator[bytes]:
    """Of all three forms."""
    yield b"# Color table\n0 background 0 0 0 0\n6 portal_vein 0 0 255 255\n"
    yield b'0 0 0 0 0 0 0 "Clear Label"\n6 0 0 255 1 1 1 "Portal vein"\n'
    yield b"label,name\n6,portal vein\n7,artery\n"


@target("label-table", ".ctbl", table_seeds)
def table(path: Path) -> None:
    """Names by label."""
    read = read_label_table(path)
    assert all(label >= 0 and name for label, (name, _) in read.items())


SEEDS = """structures:
  vein:
    method: growing
    upper: 30
    seeds_mm: [[3, 3, 2], [4, 4, 4]]
    reach: 6 mm
    smooth: 0.3 mm
    close: 1 mm
    colour: [0.2, 0.4, 1]
  muscle: {method: growing, lower: 50, seeds_voxel: [[0, 0, 0]], reach: 2 mm}
  fat: {lower: 50, seeds_mm: [[6, 5, 5]], reach: 2 mm}
"""


@target("seeds", ".yaml", lambda _: [SEEDS.encode()])
def seeds(path: Path) -> None:
    """Labels that they lead to."""
    found = segment(LIKE, read_seeds(path))
    assert min(found.voxels.values()) >= 0
    assert found.labels.shape == LIKE.shape
