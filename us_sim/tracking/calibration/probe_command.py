"""`us-sim calibrate probe`: sightings of a phantom in, the image's place on the probe out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError, PoseError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import interpolate
from us_sim.settings.spelling import counted
from us_sim.settings.text_files import read_text
from us_sim.tracking.calibration.landmarks import read_landmarks, read_table, read_wires
from us_sim.tracking.calibration.pivot import ENOUGH_FEATURES
from us_sim.tracking.calibration.probe import PixelSighting, ProbeCalibration, calibrate_probe
from us_sim.tracking.calibration.recorded_motion import read_motion, seconds_of
from us_sim.tracking.calibration.settings import ProbeSettings, Progress
from us_sim.tracking.calibration.transform_file import read_transform, write_transform

_PIXEL = {"column": "number", "row": "number"}
_POSE = dict.fromkeys(("x", "y", "z"), "length") | dict.fromkeys(("qx", "qy", "qz", "qw"), "number")
_LONGEST_GAP = 0.2  # s, between poses that are interpolated
_ROUNDED = 1e-3  # s, by which a time may differ from the stamp that it means
_LITTLE_TURN = math.radians(20.0)
_FEATURE, _PART = "feature", "part of a feature's sightings"


def calibrate_image(settings: ProbeSettings, _: Progress | None = None) -> str:
    """Find where the image lies on the probe and write it; returns a sentence with the result.

    Raises:
        UsSimError: the files cannot be read or do not determine the image's place.
    """
    out = settings.out
    to_phantom = read_transform(settings.registration) if settings.registration else Pose()
    if settings.recording is None:
        seen = _with_poses(settings.sightings, to_phantom)
    else:
        seen = _with_times(settings.sightings, settings.recording, settings.pose, to_phantom)
    phantom = _features(settings.phantom) if settings.phantom else {}
    unknown = sorted({sighting.feature for sighting in seen} - set(phantom))
    if phantom and unknown:
        raise CalibrationError(
            f"{settings.phantom}: has no {unknown[0]}, which {settings.sightings} shows; its "
            f"features are {', '.join(phantom)}"
        )
    found = calibrate_probe(
        seen, phantom, spacing=None if settings.pixel is None else np.array(settings.pixel)
    )
    deviations = np.sqrt(np.diag(found.covariance))
    rejected = int((~found.inliers).sum())
    clusters = len(np.unique(found.clusters[found.inliers]))
    features = len({sighting.feature for sighting in seen})
    write_transform(
        out,
        found.probe_pose(*settings.origin),
        from_frame="probe",
        to_frame="body",
        method=f"probe calibration, {settings.sightings.name}",
        residuals={
            "rms": found.rms,  # m
            "features": _by_feature(seen, found.residuals, found.inliers),  # m, RMS of each
            "sightings": len(seen),
            "rejected": rejected,
            "turned": found.turned,  # rad, by which the body turned
        },
        more={
            "pixel_spacing": found.spacing,  # m, between columns and between rows
            "origin_pixel": list(settings.origin),  # column, row
            "image_to_body": found.image_to_body,  # m, from (column, row, 0, 1)
            "standard_deviations": {
                "position": deviations[:3],  # m, of pixel (0, 0)
                "rotation": deviations[3:6],  # rad, about the body's axes
                "pixel_spacing": deviations[6:],  # m
                # Errors are taken to be independent between these, and related within each.
                "clusters": clusters,
                "cluster": _FEATURE if features >= ENOUGH_FEATURES else _PART,
            },
            **({"points": found.points} if found.points else {}),  # m
        },
    )
    return (
        f"{out}: pixels of {1e3 * found.spacing[0]:.4f} × {1e3 * found.spacing[1]:.4f} mm, RMS "
        f"{1e3 * found.rms:.2f} mm over {counted(len(seen) - rejected, 'sighting')}, "
        f"{rejected} left out, "
        f"± {1e3 * float(np.linalg.norm(deviations[:3])):.2f} mm and "
        f"{np.degrees(float(np.linalg.norm(deviations[3:6]))):.2f}°{_remarks(found, features)}"
    )


def _remarks(found: ProbeCalibration, features: int) -> str:
    """What makes the result less certain than it could be."""
    said = ""
    if found.turned < _LITTLE_TURN:
        said += (
            f"; the probe turned by only {math.degrees(found.turned):.0f}°, which determines "
            f"little: turn it by 30° or more about all axes"
        )
    if len(found.points) < features < ENOUGH_FEATURES:
        said += (
            f"; {features} {'feature is' if features == 1 else 'features are'} too few to tell "
            f"what a misplaced one does to the result: the deviations leave that out"
        )
    return said


def _features(path: Path) -> dict[str, NDArray[np.float64]]:
    """Wires (2, 3) m, or where the file has none points (1, 3) m, by name."""
    if path.suffix.lower() == ".xml" or _has_ends(path):
        return read_wires(path)
    return {name: point[None] for name, point in read_landmarks(path).items()}


def _has_ends(path: Path) -> bool:
    try:
        return "x2" in read_text(path).partition("\n")[0]
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot be read: {error}") from error


def _with_poses(path: Path, to_phantom: Pose) -> list[PixelSighting]:
    seen: list[PixelSighting] = []
    for feature, numbers in read_table(path, _PIXEL | _POSE, label="feature"):
        try:
            pose = to_phantom @ Pose(np.array(numbers[2:5]), np.array(numbers[5:]))
        except PoseError as error:
            raise CalibrationError(f"{path}: sighting {len(seen) + 1}: {error}") from error
        seen.append(PixelSighting(feature, numbers[0], numbers[1], pose))
    return seen


def _with_times(
    path: Path, recording: Path, name: str | None, to_phantom: Pose
) -> list[PixelSighting]:
    motion = read_motion(recording, name)
    stamps, first = np.unique(seconds_of(motion), return_index=True)
    seen: list[PixelSighting] = []
    for feature, (column, row, time) in read_table(
        path, _PIXEL | {"time": "time"}, label="feature"
    ):
        before, after, fraction = _around(stamps, time)
        if stamps[after] - stamps[before] > _LONGEST_GAP or not 0.0 <= fraction <= 1.0:
            raise CalibrationError(
                f"{path}: sighting {len(seen) + 1}: {recording.name} has no pose around "
                f"{time:.3f} s; it goes from {stamps[0]:.3f} to {stamps[-1]:.3f} s"
            )
        pose = interpolate(motion.pose(first[before]), motion.pose(first[after]), fraction)
        pose = to_phantom @ pose
        seen.append(PixelSighting(feature, column, row, pose))
    return seen


def _around(stamps: NDArray[np.float64], time: float) -> tuple[int, int, float]:
    """The stamps before and after a time, and the fraction of the way from one to the other.

    Where a stamp is the time but for rounding, it is both. Before the first and after the last
    stamp the fraction is not from 0 to 1.
    """
    after = int(np.clip(np.searchsorted(stamps, time), 1, max(len(stamps) - 1, 1)))
    for k in (after - 1, min(after, len(stamps) - 1)):
        if abs(stamps[k] - time) <= _ROUNDED:
            return k, k, 0.0
    if after == len(stamps):
        return 0, 0, math.nan
    before = after - 1
    return before, after, float((time - stamps[before]) / (stamps[after] - stamps[before]))


def _by_feature(
    seen: Sequence[PixelSighting], residuals: NDArray[np.float64], used: NDArray[np.bool_]
) -> dict[str, float]:
    names = np.array([sighting.feature for sighting in seen])
    return {
        str(name): float(np.sqrt((residuals[(names == name) & used] ** 2).mean()))
        for name in np.unique(names[used])
    }
