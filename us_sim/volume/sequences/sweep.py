"""Tracked freehand sweeps: images of a moving probe, and where each of them is."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.sequences.sequence import TrackedSequence, read_sequence
from us_sim.volume.sequences.transforms import (
    FrameTransforms,
    TransformChain,
    find_shortest_chain,
    multiply_chain,
)


@dataclass(frozen=True, eq=False)
class TrackedSweep:
    """Images of a moving probe with the pose of each; the images stay in the file."""

    path: Path
    columns: int
    rows: int
    numbers: NDArray[np.int64]  # (K,) which frames of the file these are, ascending
    times: NDArray[np.float64]  # (K,) s, the recorder's clock
    # (K, 4, 4) m, from (column, row, 0, 1) of pixel centres to the sweep's reference frame
    image_to_reference: NDArray[np.float64]
    left_out: Mapping[str, int]  # frames without a usable pose, image or time, by reason
    chain: TransformChain  # of which the poses were made
    sequence: TrackedSequence

    def read_images(self, which: Iterable[int] | None = None) -> Iterator[NDArray[np.uint8]]:
        """Yield images (rows, columns): all, or those at these indices into `numbers`."""
        numbers = self.numbers if which is None else self.numbers[list(which)]
        return self.sequence.read_images(np.searchsorted(self.sequence.numbers, numbers).tolist())


def read_sweep(
    path: str | os.PathLike[str],
    *,
    image: str = "Image",
    reference: str = "Reference",
    calibration: Mapping[str, NDArray[np.float64]] | None = None,
) -> TrackedSweep:
    """Read a sequence file, and place each of its images by a chain of transforms.

    Frames whose transform or time stamp is missing, not finite or singular, or whose status is
    not OK, are left out and counted.

    The frame ``image`` is that of pixels, which are placed in the frame ``reference``. Transforms
    (4, 4), m (pixels of images), of a ``calibration`` hold for every frame, by name; they go before
    those of the sequence that have the same name.

    Raises:
        VolumeError: the file or its images cannot be read, no chain leads from one frame to the
            other, or no frame can be used.
    """
    sequence = read_sequence(path)
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
    chain = find_shortest_chain(known, image, reference)
    if chain is None:
        raise VolumeError(
            f"{sequence.path}: no transform leads from {image} to {reference}; the known ones are "
            f"{', '.join(sorted(known))}: name others, or give the probe's calibration (such as "
            f"ImageToProbe)"
        )
    placed = multiply_chain(known, chain)
    faults = list(placed.faults)
    for k in np.flatnonzero(np.isnan(sequence.times)):
        faults[k] = faults[k] or "no Timestamp"
    for k in np.flatnonzero(~sequence.image_is_valid):
        faults[k] = "ImageStatus is not OK"
    left_out = dict(Counter(filter(None, faults)))
    if sequence.count > len(sequence):
        left_out["no field in the header"] = sequence.count - len(sequence)
    used = np.array([not fault for fault in faults], dtype=bool)
    if not used.any():
        why = ", ".join(f"{number} with {reason}" for reason, number in left_out.items())
        raise VolumeError(
            f"{sequence.path}: none of its {sequence.count} frames can be used ({why}); record the "
            f"sweep again with the probe in the tracker's view"
        )
    return TrackedSweep(
        sequence.path,
        sequence.columns,
        sequence.rows,
        sequence.numbers[used],
        sequence.times[used],
        placed.matrices[used],
        left_out,
        chain,
        sequence,
    )
