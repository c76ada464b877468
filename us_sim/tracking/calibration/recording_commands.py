"""`us-sim calibrate pivot`, `landmarks` and `time`: recordings in, YAML files out."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.settings.spelling import counted
from us_sim.tracking.calibration.landmarks import read_landmarks, register_landmarks
from us_sim.tracking.calibration.pivot import calibrate_pivot, find_dwells
from us_sim.tracking.calibration.recorded_motion import read_motion, read_signal, seconds_of
from us_sim.tracking.calibration.report_picture import draw_offset
from us_sim.tracking.calibration.settings import (
    ClockSettings,
    LandmarkSettings,
    PivotSettings,
    Progress,
)
from us_sim.tracking.calibration.time_offset import find_time_offset
from us_sim.tracking.calibration.transform_file import (
    read_transform,
    write_calibration,
    write_transform,
)

_TABLES = {".csv", ".txt", ".xml"}


def calibrate_tip(settings: PivotSettings, _: Progress | None = None) -> str:
    """Find a stylus' tip and write it; returns a sentence with the result.

    Raises:
        UsSimError: the recording cannot be read or does not determine the tip.
    """
    out = settings.out
    motion = read_motion(settings.recording, settings.pose)
    found = calibrate_pivot(motion.poses)
    write_transform(
        out,
        Pose(found.tip),
        from_frame="tip",
        to_frame=motion.topic,
        method=f"pivot about one point, {settings.recording.name}",
        residuals={"rms": found.rms, "poses": len(found.inliers), "rejected": found.rejected},
        more={
            "standard_deviations": {"position": found.deviations},  # m
            "pivot": found.pivot,  # m, frame of the recording
            "swing": found.swing,  # rad, of the direction that turned least
        },
    )
    said = ", ".join(f"{1e3 * number:z.2f}" for number in found.tip)
    largest = 1e3 * float(found.deviations.max())
    return (
        f"{out}: tip at {said} mm (± {largest:.2f}), RMS {1e3 * found.rms:.2f} mm over "
        f"{int(found.inliers.sum())} poses, {found.rejected + motion.rejected} left out"
    )


def calibrate_registration(settings: LandmarkSettings, _: Progress | None = None) -> str:
    """Register a device to the patient by landmarks; returns a sentence with the result.

    Landmarks on a probe's face, measured in the frame of its marker, likewise give the probe's
    calibration when inverted.

    Raises:
        UsSimError: the files cannot be read or do not determine the registration.
    """
    known_file, measured_file = settings.known, settings.measured
    to, out = settings.to, settings.out
    known = read_landmarks(known_file)
    if measured_file.suffix.lower() in _TABLES:
        measured, frame = read_landmarks(measured_file), "tracker"
        names = [landmark for landmark in known if landmark in measured]
        if not names:
            raise CalibrationError(
                f"{measured_file} and {known_file} share no landmark's name: name the same "
                f"landmarks alike"
            )
    else:
        measured, frame = _touched(list(known), measured_file, settings.tip, settings.pose)
        names = list(known)
    theirs = np.array([measured[landmark] for landmark in names])
    ours = np.array([known[landmark] for landmark in names])
    found = register_landmarks(theirs, ours, names)
    if settings.invert:
        found, frame, to = register_landmarks(ours, theirs, names), to, frame
    moved, turned = found.deviations[:3], found.deviations[3:]  # m and rad
    left_out = [None if math.isnan(error) else error for error in found.left_out.tolist()]
    write_transform(
        out,
        found.pose,
        from_frame=frame,
        to_frame=to,
        method=f"point registration, {measured_file.name} on {known_file.name}",
        residuals={
            "fre": found.fre,  # m
            "tre_leave_one_out": None if math.isnan(found.tre) else found.tre,  # m
            "landmarks": dict(zip(names, found.residuals, strict=True)),  # m
            "left_out": dict(zip(names, left_out, strict=True)),  # m
        },
        more={"standard_deviations": {"position": moved, "rotation": turned}},
    )
    worst = int(found.residuals.argmax())
    tre = "" if math.isnan(found.tre) else f", leave-one-out TRE {1e3 * found.tre:.2f} mm"
    alone = sorted(set(known) ^ set(measured))
    unused = f"; in one file only: {', '.join(alone)}" if alone else ""
    return (
        f"{out}: FRE {1e3 * found.fre:.2f} mm over {len(names)} landmarks (worst "
        f"{1e3 * found.residuals[worst]:.2f} mm at {names[worst]}){tre}{unused}"
    )


def calibrate_clock(settings: ClockSettings, progress: Progress | None = None) -> str:
    """Find the offset of a device's stamps; returns a sentence with the result.

    A picture of both signals goes beside the file.

    Raises:
        UsSimError: the recordings cannot be read or do not determine the offset.
    """
    out, picture = settings.out, settings.picture
    moving = read_signal(settings.moving, settings.pose, progress=progress)
    name = settings.fixed_pose or settings.pose
    fixed = read_signal(settings.fixed, name, images=settings.images, progress=progress)
    found = find_time_offset(moving, fixed, largest=settings.largest)
    write_calibration(
        out,
        {
            "time_offset": found.offset,  # s, to add to the device's stamps
            "standard_deviation": found.deviation,  # s
            "method": f"correlation of {settings.moving.name} with {settings.fixed.name}",
            "residuals": {
                "correlation": found.correlation,
                "unexplained": found.residual,  # of the fixed signal's standard deviation
                "seconds": found.seconds,
                "left_out": moving.left_out + fixed.left_out,
            },
        },
    )
    draw_offset(picture, found, moving, fixed)
    return (
        f"{out}: time_offset {1e3 * found.offset:z.1f} ms ± {1e3 * found.deviation:.1f} ms, "
        f"correlation {found.correlation:.3f} over {found.seconds:.0f} s, signals in {picture}"
    )


def _touched(
    names: list[str], recording: Path, tip: Path | None, name: str | None
) -> tuple[dict[str, NDArray[np.float64]], str]:
    """Where a stylus touched the landmarks, m, and in which frame."""
    if tip is None:
        raise CalibrationError(
            f"{recording}: is a recording of the stylus, whose tip must be known: give --tip FILE "
            f"as `us-sim calibrate pivot` writes it"
        )
    motion = read_motion(recording, name)
    offset = read_transform(tip).position
    tips = np.array([pose.apply(offset) for pose in motion.poses])
    rotations = np.array([pose.rotation for pose in motion.poses])
    dwells = find_dwells(seconds_of(motion), tips, rotations)
    if len(dwells) != len(names):
        start = seconds_of(motion)[0]
        at = ", ".join(f"{dwell.start - start:.0f}" for dwell in dwells)
        where = counted(len(dwells), "place") + (f" (at {at} s)" if at else "")
        raise CalibrationError(
            f"{recording}: the stylus pivoted on {where} where "
            f"{counted(len(names), 'landmark is', 'landmarks are')} named: touch each for two "
            f"seconds in the file's order, tilting the stylus with its tip still"
        )
    places = [dwell.position for dwell in dwells]
    return dict(zip(names, places, strict=True)), motion.frame_id
