"""The motion of a body in a recording: a bag, a tracker recording of Plus or 3D Slicer, or images.

>>> import pathlib, tempfile
>>> from us_sim.tracking.calibration.recorded_motion import read_motion
>>> header = '''DimSize = 0 0 1
... Seq_Frame0000_StylusToTrackerTransform = 1 0 0 10 0 1 0 20 0 0 1 30 0 0 0 1
... Seq_Frame0000_Timestamp = 7.5
... ElementDataFile = LOCAL
... '''
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "stylus.igs.mha")
...     _ = path.write_text(header)
...     read_motion(path, None).positions
array([[0.01, 0.02, 0.03]])
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError
from us_sim.recording.path import ProbePath, is_tracker_recording, read_path
from us_sim.recording.plus_recording import read_tracker_recording
from us_sim.tracking.calibration.time_offset import (
    PositionSignal,
    signal_of_images,
    signal_of_positions,
)
from us_sim.volume.sequences.sequence import SEQUENCE_SUFFIXES, read_sequence
from us_sim.volume.sequences.sweep import Sweep, read_sweep
from us_sim.volume.sequences.transforms import split_transform_name


def read_motion(path: Path, name: str | None) -> ProbePath:
    """The valid poses of a body.

    Args:
        path: a bag, or a tracker recording of Plus (.igs.mha, .igs.nrrd) or of 3D
            Slicer (.mrml, .mrb).
        name: a topic; or a transform such as StylusToTracker, or StylusToReference where both
            are recorded. May be None where there is one.

    Raises:
        CalibrationError: the recording has several and none is named.
        UsSimError: it cannot be read, or has no such poses.
    """
    if not is_tracker_recording(path):
        return read_path(path, name, option="--pose")
    recording = read_tracker_recording(path)
    if name is None:
        bodies = [key for key in recording.transforms if not key.startswith("Reference")]
        if len(bodies) != 1:
            raise CalibrationError(
                f"{path}: holds several transforms; name one with --pose: "
                f"{', '.join(recording.transforms)}, or one to Reference such as "
                f"{_body(sorted(bodies)[-1]) if bodies else 'Stylus'}ToReference"
            )
        name = bodies[0]
    if name in recording.transforms:
        return recording.probe_path(name)
    body, reference = split_transform_name(name) or (name, None)
    return recording.probe_path(body, reference)


def read_signal(
    path: Path,
    name: str | None,
    *,
    images: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> PositionSignal:
    """The recorded motion as one number over time.

    Args:
        path: a bag, or a recording of Plus.
        name: as in :func:`read_motion`.
        images: take a Plus recording's images even where it has poses.
        progress: told the fraction of the images that is done, and what is looked for.

    Raises:
        UsSimError: it cannot be read, or shows no motion.
    """
    of_plus = path.suffix.lower() in SEQUENCE_SUFFIXES
    if of_plus and (images or not read_sequence(path).transforms):
        sweep = read_sweep(path, tracked=False)
        return signal_of_images(sweep.times, _with_progress(sweep, progress))
    if images:
        raise CalibrationError(f"{path}: is a bag; images are read from recordings of Plus only")
    motion = read_motion(path, name)
    return signal_of_positions(seconds_of(motion), motion.positions)


def seconds_of(motion: ProbePath) -> NDArray[np.float64]:
    """(K,) s, its stamps."""
    return np.asarray(1e-9 * motion.stamps, np.float64)


def _body(name: str) -> str:
    return (split_transform_name(name) or (name, ""))[0]


def _with_progress(
    sweep: Sweep, progress: Callable[[float, str], None] | None
) -> Iterator[NDArray[np.uint8]]:
    for k, image in enumerate(sweep.images()):
        yield image
        if progress is not None:
            progress((k + 1) / len(sweep.times), "the line in each image")
