"""One transform of every frame of a sequence, and chains of them.

>>> import numpy as np
>>> from us_sim.volume.sequences.frame_transforms import FrameTransforms, along
>>> from us_sim.volume.sequences.transform_chain import shortest_chain
>>> moved = np.eye(4); moved[0, 3] = 0.02
>>> known = {"ProbeToTracker": FrameTransforms(moved[None], ("",)),
...          "ReferenceToTracker": FrameTransforms(np.eye(4)[None], ("",))}
>>> along(known, shortest_chain(known, "Reference", "Probe")).matrices[0, :3, 3]
array([-0.02,  0.  ,  0.  ])
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.sequences.sequence_header import frame_matrix
from us_sim.volume.sequences.transform_chain import TransformChain
from us_sim.volume.sequences.transform_name import is_image_frame, split_transform_name

_METRES = 1e-3  # the format holds millimetres
_SUFFIX = "Transform"
_MOST_NUMBERS = 1 << 27  # 1 GiB; eight transforms a frame for four hours at 60 Hz
UNSEEN = "an identity among poses that are none"


@dataclass(frozen=True, eq=False)
class FrameTransforms:
    """A transform over the frames; ``AToB`` takes points of A, m (pixels of an image), to B, m."""

    matrices: NDArray[np.float64]  # (K, 4, 4); nan where not valid
    faults: tuple[str, ...]  # (K,) why it is not valid; empty where it is

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """(K,) whether the frame's transform can be used."""
        return np.array([not fault for fault in self.faults], dtype=bool)


def read_transforms(path: Path, frames: Sequence[Mapping[str, str]]) -> dict[str, FrameTransforms]:
    """The transforms of all frames, by name.

    Args:
        path: which errors name.
        frames: their fields.

    Raises:
        VolumeError: the header names more transforms than any recording has.
    """
    keys = sorted({key for fields in frames for key in fields if key.endswith(_SUFFIX)})
    names = [key.removesuffix(_SUFFIX) for key in keys]
    names = [name for name in names if split_transform_name(name)]
    if 16 * len(names) * len(frames) > _MOST_NUMBERS:
        raise VolumeError(
            f"{path}: names {len(names)} transforms for {len(frames)} frames, more than can be "
            f"read; export a part of it"
        )
    return {name: _read(frames, name) for name in names}


def in_metres(name: str, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """A transform of that name, or (K, 4, 4) of them, from millimetres to metres.

    Coordinates of images stay pixels.
    """
    start, end = split_transform_name(name) or ("", "")
    from_unit = 1.0 if is_image_frame(start) else _METRES
    to_unit = 1.0 if is_image_frame(end) else _METRES
    matrix = matrix.copy()
    matrix[..., :3, :3] *= to_unit / from_unit
    matrix[..., :3, 3] *= to_unit
    return matrix


def along(transforms: Mapping[str, FrameTransforms], chain: TransformChain) -> FrameTransforms:
    """The product of a chain's transforms, valid where all of them are."""
    first = transforms[chain.steps[0][0]]
    matrices, faults = np.broadcast_to(np.eye(4), first.matrices.shape), [""] * len(first.faults)
    for name, forward in chain.steps:
        step = transforms[name]
        faults = [fault or other for fault, other in zip(faults, step.faults, strict=True)]
        matrices = (step.matrices if forward else _inverse(step)) @ matrices
    return FrameTransforms(matrices, tuple(faults))


def _inverse(step: FrameTransforms) -> NDArray[np.float64]:
    inverse = np.full_like(step.matrices, np.nan)
    inverse[step.valid] = np.linalg.inv(step.matrices[step.valid])
    inverse[step.valid, 3] = (0.0, 0.0, 0.0, 1.0)
    return inverse


def _read(frames: Sequence[Mapping[str, str]], name: str) -> FrameTransforms:
    matrices = np.full((len(frames), 4, 4), np.nan)
    faults = [""] * len(frames)
    for k, fields in enumerate(frames):
        try:
            matrices[k] = frame_matrix(fields, f"{name}{_SUFFIX}")
        except ValueError as reason:
            faults[k] = str(reason)
    identity = (matrices == np.eye(4)).all(axis=(1, 2))
    if identity.any() and (np.isfinite(matrices[:, 0, 0]) & ~identity).any():
        # No measurement is exactly that: Plus fills it in for a body it has not seen.
        matrices[identity] = np.nan
        for k in np.flatnonzero(identity).tolist():
            faults[k] = UNSEEN
    return FrameTransforms(in_metres(name, matrices), tuple(faults))
