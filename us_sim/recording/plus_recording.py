"""Tracker recordings: sequence files of Plus (`.igs.mha`, `.igs.nrrd`), with or without images.

Every sample has a time and named transforms (``ProbeToTracker``), each with a status.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError, VolumeError
from us_sim.geometry.pose import Pose
from us_sim.recording.probe_path import ProbePath
from us_sim.volume.sequences.sequence import read_sequence
from us_sim.volume.sequences.transforms import (
    FrameTransforms,
    TransformChain,
    along,
    is_image_frame,
    shortest_chain,
    split_transform_name,
)

_RIGID = 5e-3  # how far from 1 a rotation may scale; real trackers round to 3e-4


@dataclass(frozen=True, eq=False)
class TrackerRecording:
    """Rigid transforms over time; a transform ``AToB`` takes points of A to B."""

    path: Path
    times: NDArray[np.float64]  # (K,) s, the recorder's clock, as they were recorded
    transforms: Mapping[str, FrameTransforms]  # by name
    untimed: int  # samples of the file without a time, none of whose transforms is used

    def __len__(self) -> int:
        return len(self.times)

    def left_out(self, name: str) -> dict[str, int]:
        """How many samples of a transform are not valid, by reason."""
        return dict(Counter(fault for fault in self.transforms[name].faults if fault))

    def chain(self, name: str, reference: str | None = None) -> TransformChain:
        """The chain of the fewest transforms from a body to a reference frame.

        Args:
            name: of a transform (``StylusToTracker``), also one that others make up
                (``StylusToReference``), or of a body (``Stylus``).
            reference: a frame (``Reference``); by default that of the body's own transform.

        Raises:
            TrackingError: the recording has no such transform, or no chain to the reference.
        """
        body, end = split_transform_name(name) or (name, None)
        if reference is None and end and name not in self.transforms:
            reference = end
        own = [key for key in self.transforms if (split_transform_name(key) or ("",))[0] == body]
        if reference is None and name in self.transforms:
            own = [name]
        chain = None
        if reference is not None:
            chain = shortest_chain(self.transforms, body, reference)
        elif len(own) == 1:
            chain = TransformChain((split_transform_name(own[0]) or ("", ""))[1], ((own[0], True),))
        if chain is None:
            to = f" to {reference}" if reference else ""
            several = "several transforms lead" if len(own) > 1 else "no transform leads"
            raise TrackingError(
                f"{self.path}: {several} from {name}{to}; its transforms are "
                f"{', '.join(self.transforms)}"
            )
        return chain

    def poses(
        self, name: str, reference: str | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """A body's poses in a reference frame (K, 4, 4) m, and which are valid (K,); nan elsewhere.

        Arguments and errors are those of :meth:`chain`.
        """
        found = along(self.transforms, self.chain(name, reference))
        return found.matrices, found.valid

    def probe_path(
        self, name: str | None = None, reference: str | None = None, option: str = "topic"
    ) -> ProbePath:
        """The valid poses of a body as a path in the reference's frame, by the recorder's clock.

        Arguments are as for :meth:`chain`; without a name it is the recording's only transform, and
        ``option`` is what names it.

        Raises:
            TrackingError: see :meth:`chain`; or the name is missing, or no pose is valid.
        """
        if name is None:
            if len(self.transforms) != 1:
                names = ", ".join(self.transforms)
                raise TrackingError(
                    f"{self.path}: has several transforms: name one by {option}, of {names}"
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
            for reason, count in self.left_out(name).items()
        ]
        if self.untimed:
            said.append(f"{self.untimed} without a time")
        return f" ({', '.join(said)})" if said else ""


def read_tracker_recording(path: str | Path) -> TrackerRecording:
    """The transforms of a sequence file of Plus.

    A transform whose status is not OK, or that is not rigid (Plus writes zeros for a tool
    that it has not seen), is not valid; a sample without a time is left out whole. Both are
    counted.

    Raises:
        TrackingError: the file is missing, is no sequence, is cut, or holds no transform or none
            that is valid.
    """
    path = Path(path)
    try:
        sequence = read_sequence(path)
    except VolumeError as error:
        raise TrackingError(str(error)) from error
    times = sequence.times
    timed = np.flatnonzero(np.isfinite(times))
    transforms = {
        name: _rigid(series, timed)
        for name, series in sequence.transforms.items()
        if not any(map(is_image_frame, split_transform_name(name) or ()))
    }
    if not transforms:
        raise TrackingError(
            f"{path}: holds no transforms (Seq_Frame0000_ProbeToTrackerTransform); give a tracker "
            f"recording of Plus"
        )
    recording = TrackerRecording(path, times[timed], transforms, len(times) - len(timed))
    if not any(series.valid.any() for series in transforms.values()):
        raise TrackingError(
            f"{path}: none of its {len(times)} samples holds a time and a valid transform"
            f"{recording.why(transforms)}"
        )
    return recording


def _rigid(series: FrameTransforms, which: NDArray[np.intp]) -> FrameTransforms:
    """Some frames' transforms with the rotations nearest to those that trackers round.

    What scales, shears or mirrors is not valid.
    """
    matrices = series.matrices[which].copy()
    faults = [series.faults[k] for k in which]
    for k in np.flatnonzero([not fault for fault in faults]):
        left, scales, right = np.linalg.svd(matrices[k, :3, :3])
        rotation = left @ right
        if np.abs(scales - 1.0).max() > _RIGID or np.linalg.det(rotation) < 0:
            faults[k], matrices[k] = "a transform that is not rigid", np.nan
        else:
            matrices[k, :3, :3] = rotation
    return FrameTransforms(matrices, tuple(faults))
