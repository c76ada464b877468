"""Calibrations of `us-sim calibrate`: each reads files, writes a file, and returns a sentence."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from itertools import compress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.command.calibration_settings import (
    CameraCalibrationSettings,
    ClockCalibrationSettings,
    LandmarkCalibrationSettings,
    PivotCalibrationSettings,
)
from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.recording.path import ProbePath, is_tracker_recording, read_path, read_tracker_recording
from us_sim.settings.spelling import format_count
from us_sim.tracking.calibration.camera import INTRINSICS, BoardView, calibrate_camera, find_board
from us_sim.tracking.calibration.landmarks import read_landmarks, register_landmarks
from us_sim.tracking.calibration.pivot import calibrate_pivot, find_dwells
from us_sim.tracking.calibration.time_offset import (
    PositionSignal,
    compute_position_signal,
    find_time_offset,
)
from us_sim.tracking.calibration.transform_file import (
    read_transform,
    write_calibration,
    write_transform,
)
from us_sim.tracking.camera.model import write_camera_info
from us_sim.tracking.camera.rigid_body import read_rigid_body


def read_motion(path: Path, name: str | None) -> ProbePath:
    """Read the valid poses of a body.

    Args:
        path: a bag, or a tracker recording of Plus (.igs.mha, .igs.nrrd).
        name: a topic, or a transform such as StylusToTracker, or StylusToReference where both are
            recorded; None for the only one of a recording.

    Raises:
        CalibrationError: the recording has several, and none is named.
        UsSimError: the recording cannot be read, or has no such poses.
    """
    if not is_tracker_recording(path):
        return read_path(path, name, option="--pose")
    recording = read_tracker_recording(path)
    if name is None:
        bodies = [key for key in recording.transforms if not key.startswith("Reference")]
        if len(bodies) != 1:
            raise CalibrationError(
                f"{path}: holds several transforms; name one with --pose: "
                f"{', '.join(recording.transforms)}, or one such as StylusToReference"
            )
        name = bodies[0]
    return recording.make_probe_path(name)


def read_signal(path: Path, name: str | None) -> PositionSignal:
    """Reduce a recorded motion to one number over time.

    Args:
        path: as for `read_motion`.
        name: as for `read_motion`.

    Raises:
        UsSimError: the recording cannot be read, or shows no motion.
    """
    motion = read_motion(path, name)
    return compute_position_signal(convert_stamps(motion), motion.positions)


def convert_stamps(motion: ProbePath) -> NDArray[np.float64]:
    """Convert the stamps of a motion to s, (K,)."""
    return np.asarray(1e-9 * motion.stamps, np.float64)


_IMAGES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}


def calibrate_photos(settings: CameraCalibrationSettings, progress: Progress | None = None) -> str:
    """Calibrate a camera and write its camera info; return a sentence with the result.

    Args:
        settings: the photos, their board, the camera's name, and the file to write.
        progress: called with the fraction of the photos done, and the number with the board.

    Raises:
        CalibrationError: the photos cannot be read or do not determine the camera, or a file to
            write exists.
    """
    out = settings.out
    board = read_rigid_body(settings.board)
    photos = find_photos(settings.photos)
    if not photos:
        raise CalibrationError("no photo is given; name files, a folder or a pattern")
    names: list[str] = []
    blank: list[str] = []
    views: list[BoardView] = []
    size = _read(photos[0]).shape  # rows, columns
    for k, photo in enumerate(photos):
        image = _read(photo)
        if image.shape != size:
            raise CalibrationError(
                f"{photo}: has {image.shape[1]} × {image.shape[0]} pixels and the photos before "
                f"it {size[1]} × {size[0]}: all must come from one camera at one size"
            )
        view = find_board(image, board)
        (blank if view is None else names).append(photo.name)
        if view is not None:
            views.append(view)
        if progress is not None:
            progress((k + 1) / len(photos), f"{len(views)} with the board")
    if not views:
        raise CalibrationError(
            f"none of the {len(photos)} photos shows the board of {settings.board}: check its "
            f"numbers there, and try legacy: true with an old ChArUco board"
        )
    found = calibrate_camera(views, size[1], size[0])
    far_off = list(compress(names, ~found.used))
    names, views = list(compress(names, found.used)), list(compress(views, found.used))
    notes = {  # further keys, which ROS' readers ignore
        "method": f"photos of {settings.board.name}, Zhang",
        "residuals": {
            "rms": found.rms,  # pixels
            "photos": dict(zip(names, found.residuals.tolist(), strict=True)),  # RMS, pixels
            "corners": sum(len(view) for view in views),
        },
        "standard_deviations": dict(zip(INTRINSICS, found.deviations.tolist(), strict=True)),
        "largest_tilt": found.tilt,  # rad, between two boards
        "reach": found.reach,  # fraction of the distance from the image's middle to its corners
        "note": found.note,
        "photos_without_board": blank,
        "photos_left_out": far_off,
    }
    write_camera_info(out, found.camera, settings.name, notes)
    focal = " and ".join(
        f"{intrinsic} {found.camera.matrix[k, k]:.1f} ± {found.deviations[k]:.1f}"
        for k, intrinsic in enumerate(INTRINSICS[:2])
    )
    sentence = (
        f"{out}: {focal} pixels, RMS {found.rms:.3f} pixels in {format_count(len(views), 'photo')}"
        f", corners up to {100 * found.reach:.0f} % of the way to the image's"
    )
    if blank:
        sentence += f"; {len(blank)} without the board: {', '.join(blank)}"
    if far_off:
        sentence += f"; {len(far_off)} left out that fit far worse: {', '.join(far_off)}"
    return f"{sentence}; {found.note}" if found.note else sentence


def find_photos(names: Sequence[str]) -> list[Path]:
    """List the named photos, and those in named folders.

    Raises:
        CalibrationError: a name is no photo, and no folder with photos.
    """
    photos: dict[Path, None] = {}
    for text in names:
        path = Path(os.path.expanduser(text))
        inside = sorted(path.iterdir()) if path.is_dir() else []
        found = [path] if path.is_file() else [p for p in inside if p.suffix.lower() in _IMAGES]
        if not found:
            raise CalibrationError(f"{text}: there is no such photo, and no folder with any")
        photos.update(dict.fromkeys(found))
    return list(photos)


def _read(photo: Path) -> NDArray[np.uint8]:
    """Read grey values (rows, columns) as on the sensor, not turned as a header asks for."""
    data = np.fromfile(photo, np.uint8)
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None:
        raise CalibrationError(f"{photo}: is no image that can be read")
    return np.asarray(image, np.uint8)


_TABLES = {".csv", ".txt"}


def calibrate_tip(settings: PivotCalibrationSettings, _: Progress | None = None) -> str:
    """Find a stylus' tip and write it; return a sentence with the result.

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
    tip = ", ".join(f"{1e3 * number:z.2f}" for number in found.tip)
    largest = 1e3 * float(found.deviations.max())
    return (
        f"{out}: tip at {tip} mm (± {largest:.2f}), RMS {1e3 * found.rms:.2f} mm over "
        f"{int(found.inliers.sum())} poses, {found.rejected + motion.rejected} left out"
    )


def calibrate_registration(settings: LandmarkCalibrationSettings, _: Progress | None = None) -> str:
    """Register a device to the patient by landmarks; return a sentence with the result.

    Landmarks on a probe's face, measured in the frame of its marker, give the probe's calibration
    when inverted.

    Raises:
        UsSimError: the files cannot be read or do not determine the registration.
    """
    measured_file, to, out = settings.measured, settings.to, settings.out
    known = read_landmarks(settings.known)
    if measured_file.suffix.lower() in _TABLES:
        measured, frame = read_landmarks(measured_file), "tracker"
        names = [landmark for landmark in known if landmark in measured]
        if not names:
            raise CalibrationError(
                f"{measured_file} and {settings.known} share no landmark's name: name the same "
                f"landmarks alike"
            )
    else:
        measured, frame = _read_touches(list(known), measured_file, settings.tip, settings.pose)
        names = list(known)
    theirs = np.array([measured[landmark] for landmark in names])
    ours = np.array([known[landmark] for landmark in names])
    found = register_landmarks(theirs, ours, names)
    if settings.invert:
        found, frame, to = register_landmarks(ours, theirs, names), to, frame
    moved, turned = found.deviations[:3], found.deviations[3:]  # m and rad
    tre, *left_out = (None if math.isnan(m) else m for m in (found.tre, *found.left_out.tolist()))
    write_transform(
        out,
        found.pose,
        from_frame=frame,
        to_frame=to,
        method=f"point registration, {measured_file.name} on {settings.known.name}",
        residuals={
            "fre": found.fre,  # m
            "tre_leave_one_out": tre,  # m
            "landmarks": dict(zip(names, found.residuals, strict=True)),  # m
            "left_out": dict(zip(names, left_out, strict=True)),  # m
        },
        more={"standard_deviations": {"position": moved, "rotation": turned}},
    )
    worst = int(found.residuals.argmax())
    error = "" if tre is None else f", leave-one-out TRE {1e3 * tre:.2f} mm"
    alone = sorted(set(known) ^ set(measured))
    unused = f"; in one file only: {', '.join(alone)}" if alone else ""
    return (
        f"{out}: FRE {1e3 * found.fre:.2f} mm over {len(names)} landmarks (worst "
        f"{1e3 * found.residuals[worst]:.2f} mm at {names[worst]}){error}{unused}"
    )


def calibrate_clock(settings: ClockCalibrationSettings, _: Progress | None = None) -> str:
    """Find the offset of a device's stamps and write it; return a sentence with the result.

    Raises:
        UsSimError: the recordings cannot be read or do not determine the offset.
    """
    out = settings.out
    moving = read_signal(settings.moving, settings.pose)
    fixed = read_signal(settings.fixed, settings.fixed_pose or settings.pose)
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
            },
        },
    )
    return (
        f"{out}: time_offset {1e3 * found.offset:z.1f} ms ± {1e3 * found.deviation:.1f} ms, "
        f"correlation {found.correlation:.3f} over {found.seconds:.0f} s"
    )


def _read_touches(
    names: list[str], recording: Path, tip: Path | None, name: str | None
) -> tuple[dict[str, NDArray[np.float64]], str]:
    """Return the places that a stylus touched, m, by landmark, and their frame."""
    if tip is None:
        raise CalibrationError(
            f"{recording}: is a recording of the stylus, whose tip must be known: give --tip FILE "
            f"as `us-sim calibrate pivot` writes it"
        )
    motion = read_motion(recording, name)
    offset = read_transform(tip).position
    tips = np.array([pose.transform_points(offset) for pose in motion.poses])
    rotations = np.array([pose.rotation for pose in motion.poses])
    dwells = find_dwells(convert_stamps(motion), tips, rotations)
    if len(dwells) != len(names):
        start = convert_stamps(motion)[0]
        at = ", ".join(f"{dwell.start - start:.0f} s" for dwell in dwells)
        where = format_count(len(dwells), "place") + (f" (at {at})" if at else "")
        raise CalibrationError(
            f"{recording}: the stylus pivoted on {where} where "
            f"{format_count(len(names), 'landmark is', 'landmarks are')} named: touch each for two "
            f"seconds in the file's order, tilting the stylus with its tip still"
        )
    places = [dwell.position for dwell in dwells]
    return dict(zip(names, places, strict=True)), motion.frame_id
