"""Volumes, sweeps and tracker recordings."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from tests.fuzz.target import target
from us_sim.recording.path import read_path
from us_sim.volume.files.readers import read_volume
from us_sim.volume.reconstruction.calibration_file import read_calibration
from us_sim.volume.sequences.sweep import read_sweep

VOXELS = np.arange(6 * 5 * 4, dtype=np.int16).reshape(6, 5, 4)

FRAME = """Seq_Frame{0:04}_ImageToReferenceTransform = 0.2 0 0 -10 0 0 -0.2 0 0 0.2 0 {0} 0 0 0 1
Seq_Frame{0:04}_ImageToReferenceTransformStatus = OK
Seq_Frame{0:04}_ProbeToTrackerTransform = 1 0 0 {0} 0 1 0 0 0 0 1 0 0 0 0 1
Seq_Frame{0:04}_ProbeToTrackerTransformStatus = OK
Seq_Frame{0:04}_Timestamp = 0.{0}
"""


def image(kind: int = sitk.sitkUInt8) -> sitk.Image:
    """A small one, placed aslant."""
    made = sitk.Cast(sitk.GetImageFromArray(VOXELS), kind)
    turn = sitk.VersorRigid3DTransform()
    turn.SetRotation((0.3, -0.5, 0.8), 0.7)
    made.SetDirection(turn.GetMatrix())
    made.SetSpacing((0.5, 0.25, 2.0))
    made.SetOrigin((-12.5, 40.0, 7.75))
    return made


def seeds_of(suffix: str) -> Callable[[Path], Iterator[bytes]]:
    """Makes files of a format, packed and not, of several types."""

    def seeds(folder: Path) -> Iterator[bytes]:
        for kind in (sitk.sitkUInt8, sitk.sitkInt16, sitk.sitkFloat32):
            for packed in (False, True):
                file = folder / f"volume{suffix}"
                sitk.WriteImage(image(kind), str(file), packed)
                yield file.read_bytes()

    return seeds


def read(path: Path) -> None:
    """The volume, which lies somewhere."""
    volume = read_volume(path)
    assert min(volume.shape) >= 2
    assert np.isfinite(volume.index_to_patient).all()
    assert np.isfinite(volume.patient_to_index).all()
    assert np.isfinite(volume.extent).all()
    assert volume.intensities.max() <= 255


for name in ("mha", "nrrd", "nii", "nii.gz"):
    target(name.replace(".", "-"), f".{name}", seeds_of(f".{name}"))(read)


def sequence_seeds(_: Path) -> Iterator[bytes]:
    """Tracked frames, packed and not."""
    frames = "".join(FRAME.format(number) for number in range(4))
    pixels = bytes(range(96))
    packed = zlib.compress(pixels)
    for data, more in (
        (pixels, ""),
        (packed, f"CompressedData = True\nCompressedDataSize = {len(packed)}\n"),
    ):
        header = (
            "ObjectType = Image\nNDims = 3\nDimSize = 6 4 4\nElementType = MET_UCHAR\n"
            f"UltrasoundImageOrientation = MFA\n{more}{frames}ElementDataFile = LOCAL\n"
        )
        yield header.encode() + data


def nrrd_sequence_seeds(_: Path) -> Iterator[bytes]:
    """The same as NRRD, in another orientation; and in colours."""
    frames = "".join(FRAME.format(number) for number in range(4)).replace(" = ", ":=")
    for sizes, kinds, code in (
        ("6 4 1 4", "domain domain domain list", "UNA"),
        ("3 2 4 4", "vector domain domain list", "FM"),
    ):
        for encoding, pack in (("raw", bytes), ("gzip", gzip.compress)):
            header = (
                f"NRRD0004\ntype: uint8\ndimension: 4\nsizes: {sizes}\nkinds: {kinds}\n"
                f"encoding: {encoding}\nUltrasoundImageOrientation:={code}\n{frames}\n"
            )
            yield header.encode() + pack(bytes(range(96)))


@target("sweep", ".igs.mha", sequence_seeds)
def sweep(path: Path) -> None:
    """All images, and where they are."""
    read = read_sweep(path)
    assert np.isfinite(read.image_to_reference).all()
    assert all(image.shape == (read.rows, read.columns) for image in read.images())


target("sweep-nrrd", ".igs.nrrd", nrrd_sequence_seeds)(sweep)


CALIBRATION = """<PlusConfiguration version="2.1"><CoordinateDefinitions>
<Transform From="Image" To="Probe" Error="1.6"
  Matrix="-0.001 0.078 -0.008 15.3 -0.083 0.003 0.015 49.5 0.015 0.007 0.080 -8.6 0 0 0 1"/>
</CoordinateDefinitions><VolumeReconstruction ClipRectangleOrigin="192 16"
 ClipRectangleSize="420 580" FanAnglesDeg="-45 45" FanOriginPixel="380 20"
 FanRadiusStartPixel="120" FanRadiusStopPixel="360"/></PlusConfiguration>"""


@target("sweep-calibration", ".xml", lambda _: [CALIBRATION.encode()])
def sweep_calibration(path: Path) -> None:
    """Where the image lies on the probe, and which part of it is tissue."""
    found = read_calibration(path, "Probe")
    assert all(np.isfinite(matrix).all() for matrix in found.transforms.values())


@target("tracker", ".igs.mha", sequence_seeds)
def tracker(path: Path) -> None:
    """A path of it."""
    poses = read_path(path, "ProbeToTracker")
    assert np.isfinite(poses.positions).all()
    assert np.isfinite(poses.orientations).all()


target("tracker-nrrd", ".igs.nrrd", nrrd_sequence_seeds)(tracker)
