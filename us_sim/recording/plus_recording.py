"""Tracker recordings of Plus: the header of a sequence file (`.igs.mha`), with or without images.

Every sample has a time and named transforms (``ProbeToTracker``), each with a status.

>>> import pathlib, tempfile
>>> from us_sim.recording.plus_recording import read_tracker_recording
>>> header = '''ObjectType = Image
... NDims = 3
... DimSize = 0 0 2
... ElementType = MET_OTHER
... Seq_Frame0000_StylusToTrackerTransform = 1 0 0 10 0 1 0 20 0 0 1 30 0 0 0 1
... Seq_Frame0000_StylusToTrackerTransformStatus = OK
... Seq_Frame0000_Timestamp = 7.5
... Seq_Frame0001_StylusToTrackerTransform = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
... Seq_Frame0001_StylusToTrackerTransformStatus = INVALID
... Seq_Frame0001_Timestamp = 7.6
... ElementDataFile = LOCAL
... '''
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "stylus.igs.mha")
...     _ = path.write_text(header)
...     recording = read_tracker_recording(path)
>>> recording.transforms["StylusToTracker"][0, :3, 3], recording.left_out
(array([0.01, 0.02, 0.03]), {'StylusToTracker': {'StylusToTrackerTransformStatus is not OK': 1}})
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.recording.path import ProbePath
from us_sim.volume.files.metaimage import metaimage_header
from us_sim.volume.sequences.sequence_header import frame_fields, frame_matrix, frame_time

__all__ = ["TrackerRecording", "TransformChain", "read_tracker_recording"]

_METRES = 1e-3  # the format holds millimetres
_MOST_SAMPLES = 1 << 20  # four hours at 60 Hz
_RIGID = 5e-3  # how far from 1 a rotation may scale; real trackers round to 3e-4


@dataclass(frozen=True)
class TransformChain:
    """Transforms that lead to a reference frame one after the other, each forwards or inverted."""

    reference: str
    steps: tuple[tuple[str, bool], ...]


@dataclass(frozen=True, eq=False)
class TrackerRecording:
    """Transforms over time; a transform ``AToB`` takes points of A to B."""

    path: Path
    times: NDArray[np.float64]  # (K,) s, the recorder's clock, as they were recorded
    transforms: Mapping[str, NDArray[np.float64]]  # (K, 4, 4) m by name; nan where not valid
    valid: Mapping[str, NDArray[np.bool_]]  # (K,)
    left_out: Mapping[str, Mapping[str, int]]  # samples that are not valid: by name, by reason
    untimed: int  # samples of the file without a time, none of whose transforms is used

    def __len__(self) -> int:
        return len(self.times)

    def chain(self, name: str, reference: str | None = None) -> TransformChain:
        """The chain of the fewest transforms from a body to a reference frame.

        Args:
            name: of a transform (``StylusToTracker``), also one that others make up
                (``StylusToReference``), or of a body (``Stylus``).
            reference: a frame (``Reference``); by default that of the body's own transform.

        Raises:
            TrackingError: the recording has no such transform, or no chain to the reference.
        """
        body, end = _ends(name)
        if reference is None and end and name not in self.transforms:
            reference = end
        own = [key for key in self.transforms if _ends(key)[0] == body]
        if reference is None and name in self.transforms:
            own = [name]
        chain = None
        if reference is not None:
            chain = _fewest(self._steps(), body, reference)
        elif len(own) == 1:
            chain = TransformChain(_ends(own[0])[1], ((own[0], True),))
        if chain is None:
            to = f" to {reference}" if reference else ""
            several = "several transforms lead" if len(own) > 1 else "no transform leads"
            raise TrackingError(
                f"{self.path}: {several} from {name}{to}; name one of {', '.join(self.transforms)}"
            )
        return chain

    def poses(
        self, name: str, reference: str | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """A body's poses in a reference frame (K, 4, 4) m, and which are valid (K,); nan elsewhere.

        Args:
            name: as in :meth:`chain`.
            reference: as in :meth:`chain`.

        Raises:
            TrackingError: see :meth:`chain`.
        """
        matrices = np.broadcast_to(np.eye(4), (len(self), 4, 4))
        valid = np.ones(len(self), dtype=bool)
        for key, forward in self.chain(name, reference).steps:
            step = self.transforms[key]
            matrices = (step if forward else _inverse(step)) @ matrices
            valid &= self.valid[key]
        return matrices, valid

    def probe_path(self, name: str | None = None, reference: str | None = None) -> ProbePath:
        """The valid poses of a body as a path in the reference's frame.

        Its stamps are the recorder's clock.

        Args:
            name: as in :meth:`chain`; by default the recording's only transform.
            reference: as in :meth:`chain`.

        Raises:
            TrackingError: see :meth:`chain`; or the name is missing, or no pose is valid.
        """
        if name is None:
            if len(self.transforms) != 1:
                raise TrackingError(
                    f"{self.path}: has several transforms; name one of {', '.join(self.transforms)}"
                )
            (name,) = self.transforms
        chain = self.chain(name, reference)
        matrices, valid = self.poses(name, reference)
        why = self.why(key for key, _ in chain.steps)
        if not valid.any():
            raise TrackingError(
                f"{self.path}: none of the {len(self)} poses of {name} is valid{why}"
            )
        poses = [Pose.from_matrix(matrix) for matrix in matrices[valid]]
        rejected = self.untimed + int((~valid).sum())
        count = self.untimed + len(self)
        return ProbePath(
            topic=name,
            frame_id=chain.reference,
            stamps=np.round(self.times[valid] * 1e9).astype(np.int64),
            positions=np.array([pose.position for pose in poses]),
            orientations=np.array([pose.orientation for pose in poses]),
            rejected=rejected,
            note=f"{rejected} of the {count} poses of {name} are left out{why}" if rejected else "",
        )

    def why(self, names: Iterable[str]) -> str:
        """The samples of these transforms that were left out, in brackets, or an empty text."""
        said = [
            f"{count} with {reason}"
            for name in names
            for reason, count in self.left_out.get(name, {}).items()
        ]
        if self.untimed:
            said.append(f"{self.untimed} without a time")
        return f" ({', '.join(said)})" if said else ""

    def _steps(self) -> dict[str, list[tuple[str, str, bool]]]:
        """From each frame: where to, by which transform, and whether forwards."""
        steps: dict[str, list[tuple[str, str, bool]]] = {}
        for key in self.transforms:
            start, end = _ends(key)
            steps.setdefault(start, []).append((end, key, True))
            steps.setdefault(end, []).append((start, key, False))
        return steps


def read_tracker_recording(path: str | Path) -> TrackerRecording:
    """The transforms of a sequence file of Plus.

    A transform whose status is not OK, or that is not rigid (Plus writes zeros for what it has
    not seen), is not valid; a sample without a time is left out whole. Both are counted.

    Raises:
        TrackingError: the file is missing, is no sequence, is cut, or holds no transform or none
            that is valid.
    """
    path = Path(path)
    header = _header(path)
    frames = frame_fields(header)
    keys = sorted(
        {
            key
            for fields in frames.values()
            for key in fields
            if key.endswith("Transform") and all(_ends(key.removesuffix("Transform")))
        }
    )
    if not keys:
        raise TrackingError(
            f"{path}: holds no transforms (Seq_Frame0000_ProbeToTrackerTransform); give a tracker "
            f"recording of Plus"
        )
    count = _count(path, header)
    times: list[float] = []
    timed: list[Mapping[str, str]] = []
    for number in range(count):
        try:
            times.append(frame_time(frames.get(number, {})))
        except ValueError:
            continue
        timed.append(frames[number])
    read = {key.removesuffix("Transform"): _read(timed, key) for key in keys}
    transforms = {name: matrices for name, (matrices, _) in read.items()}
    recording = TrackerRecording(
        path,
        np.array(times),
        transforms,
        {name: np.isfinite(matrices[:, 0, 0]) for name, matrices in transforms.items()},
        {name: reasons for name, (_, reasons) in read.items() if reasons},
        count - len(timed),
    )
    if not any(flags.any() for flags in recording.valid.values()):
        raise TrackingError(
            f"{path}: none of its {count} samples holds a time and a valid transform"
            f"{recording.why(transforms)}"
        )
    return recording


def _read(
    samples: Sequence[Mapping[str, str]], key: str
) -> tuple[NDArray[np.float64], dict[str, int]]:
    """One transform (K, 4, 4) m of every sample, nan where it is not valid, and why not."""
    reasons: dict[str, int] = {}
    matrices = np.full((len(samples), 4, 4), np.nan)
    for matrix, fields in zip(matrices, samples, strict=True):
        try:
            matrix[:] = _rigid(frame_matrix(fields, key))
        except ValueError as reason:
            reasons[str(reason)] = reasons.get(str(reason), 0) + 1
    identity = (matrices == np.eye(4)).all(axis=(1, 2))
    moved = np.isfinite(matrices[:, 0, 0]) & ~identity
    if identity.any() and moved.any():
        # No measurement is exactly that: Plus fills it in for a body it has not seen.
        matrices[identity] = np.nan
        reasons["an identity among poses that are none"] = int(identity.sum())
    return matrices, reasons


def _header(path: Path) -> dict[str, str]:
    try:
        # The first bytes tell, so that a vast file of another kind is not read as a header.
        with path.open("rb") as file:
            if b"=" not in file.read(256):
                raise TrackingError(f"{path}: is no tracker recording (.igs.mha) of Plus")
        header, _ = metaimage_header(path)
    except OSError as error:
        raise TrackingError(
            f"{path}: {error.strerror or error}; give a tracker recording (.igs.mha) of Plus"
        ) from error
    if "ElementDataFile" not in header:
        raise TrackingError(f"{path}: ends within its header, so it is cut; copy it again")
    return header


def _count(path: Path, header: Mapping[str, str]) -> int:
    """How many samples there are; the last number of DimSize, which may begin with 0 0."""
    try:
        count = int(header["DimSize"].split()[-1])
    except (KeyError, ValueError, IndexError):
        count = 0
    if not 1 <= count <= _MOST_SAMPLES:
        raise TrackingError(
            f"{path}: its DimSize is {header.get('DimSize')!r} where a tracker recording ends it "
            f"with the number of samples, {_MOST_SAMPLES} at most; export it again"
        )
    return count


def _rigid(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The transform in metres, with the rotation that is nearest to what trackers round.

    Raises:
        ValueError: it scales, shears or mirrors.
    """
    left, scales, right = np.linalg.svd(matrix[:3, :3])
    rotation = left @ right
    if np.abs(scales - 1.0).max() > _RIGID or np.linalg.det(rotation) < 0:
        raise ValueError("a transform that is not rigid")
    matrix[:3, :3] = rotation
    matrix[:3, 3] *= _METRES
    return matrix


def _inverse(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverses of rigid transforms (K, 4, 4)."""
    inverse = np.zeros_like(matrices)
    inverse[:, :3, :3] = matrices[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("kij,kj->ki", inverse[:, :3, :3], matrices[:, :3, 3])
    inverse[:, 3, 3] = 1.0
    return inverse


def _ends(name: str) -> tuple[str, str]:
    """The frames of ``ProbeToTracker``; Plus forbids ``To`` in a frame's name."""
    start, _, end = name.partition("To")
    return start, end


def _fewest(
    steps: Mapping[str, list[tuple[str, str, bool]]], start: str, goal: str
) -> TransformChain | None:
    """The shortest chain from one frame to another; None where there is none."""
    chains: dict[str, tuple[tuple[str, bool], ...]] = {start: ()}
    waiting = deque([start])
    while waiting:
        frame = waiting.popleft()
        if frame == goal and chains[frame]:
            return TransformChain(goal, chains[frame])
        for end, key, forward in steps.get(frame, []):
            if end not in chains:
                chains[end] = (*chains[frame], (key, forward))
                waiting.append(end)
    return None
