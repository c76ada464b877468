"""Tracked freehand sweeps: images of a moving probe, and where each of them is.

>>> import pathlib, tempfile
>>> from us_sim.volume.sequences.sweep import read_sweep
>>> header = '''ObjectType = Image
... NDims = 3
... DimSize = 4 3 1
... ElementType = MET_UCHAR
... UltrasoundImageOrientation = MFA
... Seq_Frame0000_ImageToReferenceTransform = 0.2 0 0 -10 0 0 -0.2 0 0 0.2 0 30 0 0 0 1
... Seq_Frame0000_Timestamp = 0.5
... ElementDataFile = LOCAL
... '''
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "sweep.igs.mha")
...     _ = path.write_bytes(header.encode() + bytes(range(12)))
...     sweep = read_sweep(path)
...     (image,) = sweep.images([0])
>>> sweep.image_to_reference[0] @ [3, 2, 0, 1]
array([-0.0094,  0.    ,  0.0304,  1.    ])
>>> image[2]
array([ 8,  9, 10, 11], dtype=uint8)
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.sequences.frame_transforms import FrameTransforms, along
from us_sim.volume.sequences.sequence import TrackedSequence, read_sequence
from us_sim.volume.sequences.transform_chain import TransformChain, shortest_chain

IMAGE, REFERENCE = "Image", "Reference"


@dataclass(frozen=True, eq=False)
class Sweep:
    """Images of a moving probe with the pose of each; the images stay in the file."""

    path: Path
    columns: int
    rows: int
    numbers: NDArray[np.int64]  # (K,) which frames of the file these are, ascending
    times: NDArray[np.float64]  # (K,) s, the recorder's clock
    # (K, 4, 4) m, from (column, row, 0, 1) of pixel centres to the sweep's reference frame
    image_to_reference: NDArray[np.float64]
    left_out: Mapping[str, int]  # frames without a usable pose, image or time, by reason
    chain: TransformChain  # of which the poses were made; empty without poses
    sequence: TrackedSequence

    def images(self, which: Iterable[int] | None = None) -> Iterator[NDArray[np.uint8]]:
        """The images (rows, columns), ascending, one in memory at a time.

        Args:
            which: indices into `numbers`; all without it.

        Raises:
            VolumeError: the compressed data are damaged.
        """
        numbers = self.numbers if which is None else self.numbers[sorted(set(which))]
        return self.sequence.require_images().read(int(number) for number in numbers)


def read_sweep(path: str | os.PathLike[str], *, tracked: bool = True) -> Sweep:
    """The images of a sequence file whose transforms lead from its image to a reference frame.

    Frames whose transform or time stamp is missing, not finite or singular, or whose status is
    not OK, are left out and counted.

    Args:
        path: of the file.
        tracked: False takes images without a pose too; the sweep's poses are then all nan.

    Raises:
        VolumeError: the file is missing, is no sequence of images that can be read, is cut, or no
            frame of it can be used.
    """
    sequence = read_sequence(path)
    if tracked:
        return sweep_of(sequence)
    return _sweep(sequence, None, TransformChain("", ()))


def sweep_of(
    sequence: TrackedSequence,
    *,
    image: str = IMAGE,
    reference: str = REFERENCE,
    calibration: Mapping[str, NDArray[np.float64]] | None = None,
) -> Sweep:
    """The images of a sequence, each placed by a chain of transforms.

    Args:
        sequence: with images.
        image: the frame of the images' pixels.
        reference: the frame in which they are placed.
        calibration: transforms (4, 4), m (pixels of images), that hold for every frame, by name;
            they go before those of the sequence that have the same name.

    Raises:
        VolumeError: the images cannot be read, no chain leads from one frame to the other, or no
            frame can be used.
    """
    sequence.require_images()
    count = len(sequence)
    known = dict(sequence.transforms)
    if not known:
        raise VolumeError(
            f"{sequence.path}: its frames have no transforms, so nothing says where the images "
            f"lie; record it again with a tracked probe"
        )
    for name, matrix in (calibration or {}).items():
        known[name] = FrameTransforms(np.broadcast_to(matrix, (count, 4, 4)), ("",) * count)
    chain = shortest_chain(known, image, reference)
    if chain is None:
        recorded = ", ".join(sorted(known)) or "none"
        raise VolumeError(
            f"{sequence.path}: no transform leads from {image} to {reference}; the known ones are "
            f"{recorded}: name others, or give the probe's calibration (such as ImageToProbe)"
        )
    return _sweep(sequence, along(known, chain), chain)


def _sweep(
    sequence: TrackedSequence, placed: FrameTransforms | None, chain: TransformChain
) -> Sweep:
    """The frames that can be used."""
    sequence.require_images()
    faults = sequence.faults(placed, images=True)
    left_out = sequence.left_out(faults)
    used = np.array([not fault for fault in faults], dtype=bool)
    if not used.any():
        why = ", ".join(f"{number} with {reason}" for reason, number in left_out.items())
        raise VolumeError(
            f"{sequence.path}: none of its {sequence.count} frames can be used ({why}); record the "
            f"sweep again with the probe in the tracker's view"
        )
    nowhere = np.full((len(sequence), 4, 4), math.nan)
    return Sweep(
        sequence.path,
        sequence.columns,
        sequence.rows,
        sequence.numbers[used],
        sequence.times[used],
        (nowhere if placed is None else placed.matrices)[used],
        left_out,
        chain,
        sequence,
    )
