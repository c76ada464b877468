"""Named transforms between frames, as tracked sequences of Plus hold them, and chains of them."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.volume.files.readers import FRAME_KEY

_LARGEST = 1e7  # mm, of any transform's numbers, so that products of them stay finite


def split_transform_name(name: str) -> tuple[str, str] | None:
    """Return the frames that a transform leads from and to; None for a name of no transform.

    Plus (IGSIO, igsioTransformName::SetTransformName) splits a name at the one ``To`` whose next
    character is no lower-case letter, so that a body may be called ``Tool`` or ``Torso``. Frames
    begin with a capital letter, as Plus makes them.

    >>> split_transform_name("TestToolToTracker"), split_transform_name("ToolTip")
    (('TestTool', 'Tracker'), None)
    """
    found = list(re.finditer(r"To(?=[^a-z])", name))
    if len(found) != 1 or not found[0].start():
        return None
    start, end = name[: found[0].start()], name[found[0].end() :]
    return start[0].upper() + start[1:], end[0].upper() + end[1:]


def is_image_frame(frame: str) -> bool:
    """Tell whether a frame is an image's, whose coordinates are pixels and not millimetres."""
    return frame.startswith("Image") or frame.endswith("Image")


@dataclass(frozen=True)
class TransformChain:
    """Transforms that lead to a reference frame one after the other, each forwards or inverted."""

    reference: str
    steps: tuple[tuple[str, bool], ...]


def find_shortest_chain(names: Iterable[str], start: str, goal: str) -> TransformChain | None:
    """Find the fewest transforms that lead from one frame to another; None where none do."""
    steps: dict[str, list[tuple[str, str, bool]]] = {}  # from a frame: where to, by what, forwards
    for name in names:
        if ends := split_transform_name(name):
            steps.setdefault(ends[0], []).append((ends[1], name, True))
            steps.setdefault(ends[1], []).append((ends[0], name, False))
    chains: dict[str, tuple[tuple[str, bool], ...]] = {start: ()}
    waiting = deque([start])
    while waiting and goal not in chains:
        frame = waiting.popleft()  # breadth first, so that the first chain is a shortest one
        for end, name, forward in steps.get(frame, []):
            if end not in chains:
                chains[end] = (*chains[frame], (name, forward))
                waiting.append(end)
    return TransformChain(goal, chains[goal]) if chains.get(goal) else None


@dataclass(frozen=True, eq=False)
class FrameTransforms:
    """A transform over the frames; ``AToB`` takes points of A, m (pixels of an image), to B, m."""

    matrices: NDArray[np.float64]  # (K, 4, 4); nan where not valid
    faults: tuple[str, ...]  # (K,) why it is not valid; empty where it is

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """(K,) true where the frame's transform can be used."""
        return np.array([not fault for fault in self.faults], dtype=bool)


def split_frame_fields(header: Mapping[str, str]) -> dict[int, dict[str, str]]:
    """Return the fields of each frame by its number, their names without ``Seq_Frame0000_``."""
    frames: dict[int, dict[str, str]] = {}
    for key, value in header.items():
        if match := FRAME_KEY.fullmatch(key):
            frames.setdefault(int(match[1]), {})[match[2]] = value
    return frames


def parse_frame_matrix(fields: Mapping[str, str], key: str) -> NDArray[np.float64]:
    """Parse a frame's transform (4, 4), which the format holds in mm, and maybe scaled.

    Raises:
        ValueError: with the reason why it cannot be used: its status is not OK, it is missing, is
            not 16 finite numbers, or is singular.
    """
    if fields.get(f"{key}Status", "OK").upper() != "OK":
        raise ValueError(f"{key}Status is not OK")
    if key not in fields:
        raise ValueError(f"no {key}")
    try:
        matrix = np.array([float(number) for number in fields[key].split()]).reshape(4, 4)
    except ValueError:
        raise ValueError("a transform that is not 16 numbers") from None
    with np.errstate(all="ignore"):
        steps = np.linalg.norm(matrix[:3, :3], axis=0)
        spans = abs(np.linalg.det(matrix[:3, :3] / steps)) > 1e-6
        spans &= steps.min() > 1.0 / _LARGEST and np.abs(matrix).max() < _LARGEST
    if not (np.isfinite(matrix).all() and spans and np.array_equal(matrix[3], [0, 0, 0, 1])):
        raise ValueError("a transform that is singular or not finite")
    return matrix


def parse_frame_time(fields: Mapping[str, str]) -> float:
    """Return the time of a frame, s of the recorder's clock; nan where it does not say it."""
    try:
        time = float(fields["Timestamp"])
    except (KeyError, ValueError):
        return math.nan
    return time if math.isfinite(time) else math.nan


def read_transforms(frames: Sequence[Mapping[str, str]]) -> dict[str, FrameTransforms]:
    """Read the transforms of all frames, given the fields of each, by name."""
    keys = sorted({key for fields in frames for key in fields if key.endswith("Transform")})
    names = filter(split_transform_name, (key.removesuffix("Transform") for key in keys))
    return {name: _over_frames(frames, name) for name in names}


def _over_frames(frames: Sequence[Mapping[str, str]], name: str) -> FrameTransforms:
    matrices = np.full((len(frames), 4, 4), np.nan)
    faults = [""] * len(frames)
    for k, fields in enumerate(frames):
        try:
            matrices[k] = parse_frame_matrix(fields, f"{name}Transform")
        except ValueError as reason:
            faults[k] = str(reason)
    identity = (matrices == np.eye(4)).all(axis=(1, 2))
    if identity.any() and (np.isfinite(matrices[:, 0, 0]) & ~identity).any():
        # No measurement is exactly that: Plus fills it in for a body it has not seen.
        matrices[identity] = np.nan
        for k in np.flatnonzero(identity).tolist():
            faults[k] = "an identity among poses that are none"
    return FrameTransforms(to_metres(name, matrices), tuple(faults))


def to_metres(name: str, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn a transform of that name, or (K, 4, 4) of them, from millimetres to metres.

    Coordinates of images stay pixels.
    """
    start, end = split_transform_name(name) or ("", "")
    from_unit = 1.0 if is_image_frame(start) else 1e-3
    to_unit = 1.0 if is_image_frame(end) else 1e-3
    matrix = matrix.copy()
    matrix[..., :3, :3] *= to_unit / from_unit
    matrix[..., :3, 3] *= to_unit
    return matrix


def multiply_chain(
    transforms: Mapping[str, FrameTransforms], chain: TransformChain
) -> FrameTransforms:
    """Return the product of a chain's transforms, valid where all of them are."""
    first = transforms[chain.steps[0][0]]
    matrices, faults = np.broadcast_to(np.eye(4), first.matrices.shape), [""] * len(first.faults)
    for name, forward in chain.steps:
        step = transforms[name]
        faults = [fault or other for fault, other in zip(faults, step.faults, strict=True)]
        matrix = step.matrices
        if not forward:
            matrix = np.full_like(step.matrices, np.nan)
            matrix[step.valid] = np.linalg.inv(step.matrices[step.valid])
            matrix[step.valid, 3] = (0.0, 0.0, 0.0, 1.0)
        matrices = matrix @ matrices
    return FrameTransforms(matrices, tuple(faults))
