"""Point registration by landmarks, and their files: CSV with a header.

Horn (1987), Closed-form solution of absolute orientation, by singular values. FRE is the fiducial,
TRE the target registration error (Fitzpatrick 1998); the latter is measured by leaving each
landmark out once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import cross_matrix
from us_sim.settings.quantity import Quantity

Array = NDArray[np.float64]

_FLATTEST = 0.02  # width of the landmarks' spread over its length, below which they are in line
_WORST_FIT = 0.1  # FRE over the landmarks' spread, above which they are not the same points


@dataclass(frozen=True, eq=False)
class LandmarkRegistration:
    """A transform from measured to known landmarks, and how well they fit."""

    pose: Pose  # of the measured points' frame in that of the known ones
    names: tuple[str, ...]
    residuals: Array  # (N,) m, distance of each after the transform
    fre: float  # m, root mean square of these
    left_out: Array  # (N,) m, of each when the others make the transform; nan of 3
    deviations: Array  # (6,) m and rad, of position and rotation, to's axes

    @property
    def tre(self) -> float:
        """m, root mean square error at a landmark that took no part; nan of three."""
        return math.sqrt(float((self.left_out**2).mean()))


def register_landmarks(
    measured: Array, known: Array, names: Sequence[str] = ()
) -> LandmarkRegistration:
    """Find the rigid transform that lays the measured points on the known ones.

    Args:
        measured: (N, 3) m, in the device's frame.
        known: (N, 3) m, the same points in the same order.
        names: of the points, for messages; numbers without them.

    Raises:
        CalibrationError: there are fewer than 3, a coordinate is not finite, they lie on a line,
            or are not the same points (another order, unit or a mirrored frame).

    Examples:
        >>> phantom = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
        >>> found = register_landmarks(phantom, phantom[:, [1, 2, 0]] + 0.5)
        >>> found.pose.position
        array([0.5, 0.5, 0.5])
    """
    measured, known = np.asarray(measured, np.float64), np.asarray(known, np.float64)
    names = tuple(names) or tuple(str(k + 1) for k in range(len(known)))
    _check(measured, known, names)
    pose = _fit(measured, known)
    residuals = np.linalg.norm(pose.transform_points(measured) - known, axis=1)
    fre = math.sqrt(float((residuals**2).mean()))
    _check_fit(measured, known, residuals, fre, names)
    left_out = _leave_one_out(measured, known)
    deviations = _deviations(known, pose.position, residuals)
    return LandmarkRegistration(pose, names, residuals, fre, left_out, deviations)


def _check(measured: Array, known: Array, names: Sequence[str]) -> None:
    if measured.shape != known.shape or known.ndim != 2 or known.shape[1] != 3:
        raise CalibrationError(
            f"a registration needs as many measured as known landmarks of 3 coordinates, not "
            f"{len(measured)} and {len(known)}"
        )
    if len(known) < 3:
        raise CalibrationError(f"a registration needs at least 3 landmarks, not {len(known)}")
    for points, what in ((measured, "measured"), (known, "known")):
        if not np.isfinite(points).all():
            bad = names[int(np.argmin(np.isfinite(points).all(axis=1)))]
            raise CalibrationError(f"landmark {bad}: its {what} coordinates are not finite")
        length, width, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if width <= _FLATTEST * length or length == 0.0:
            # A tenth of the landmarks' extent; 10 mm where they have none.
            advised = max(1e2 * 2.0 * length / math.sqrt(len(points)), 10.0)
            raise CalibrationError(
                f"the {what} landmarks lie on a line, about which the registration may turn: add "
                f"one at least {advised:.0f} mm beside it"
            )


def _check_fit(
    measured: Array, known: Array, residuals: Array, fre: float, names: Sequence[str]
) -> None:
    spread, theirs = (
        math.sqrt(float(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
        for points in (known, measured)
    )
    if not 0.5 < theirs / spread < 2.0:
        raise CalibrationError(
            f"the measured landmarks are {theirs / spread:.3g} times as far apart as the known "
            f"ones: give both in metres"
        )
    if fre > _WORST_FIT * spread:
        raise CalibrationError(
            f"the landmarks do not fit (FRE {1e3 * fre:.1f} mm, worst at landmark "
            f"{names[int(residuals.argmax())]}): check their order, and that neither frame is "
            f"mirrored"
        )


def _fit(measured: Array, known: Array) -> Pose:
    from_middle, to_middle = measured.mean(axis=0), known.mean(axis=0)
    turn, _ = Rotation.align_vectors(known - to_middle, measured - from_middle)
    return Pose(to_middle - turn.apply(from_middle), turn.as_quat())


def _leave_one_out(measured: Array, known: Array) -> Array:
    errors = np.full(len(known), np.nan)
    if len(known) > 3:
        for k in range(len(known)):
            others = np.arange(len(known)) != k
            pose = _fit(measured[others], known[others])
            errors[k] = np.linalg.norm(
                pose.transform_points(measured[k : k + 1]) - known[k : k + 1]
            )
    return errors


def _deviations(known: Array, origin: Array, residuals: Array) -> Array:
    """Return standard deviations (6,) m, rad of the transform, for equal errors of all coordinates.

    They are those of the measured frame's origin, and of the rotation about the axes.
    """
    count = len(known)
    # A rotation w about the landmarks' middle moves a landmark by w × (landmark - middle).
    middle = known.mean(axis=0)
    inertia = sum(cross_matrix(point).T @ cross_matrix(point) for point in known - middle)
    variance = float((residuals**2).sum()) / (3 * count - 6)
    rotation = variance * np.linalg.inv(np.asarray(inertia))
    lever = cross_matrix(origin - middle)
    position = variance / count * np.eye(3) + lever @ rotation @ lever.T
    return np.sqrt(np.concatenate([np.diag(position), np.diag(rotation)]))


_LENGTH = Quantity("length")


def read_landmarks(path: str | Path) -> dict[str, Array]:
    """Read points (3,) m by name, in the file's order.

    Args:
        path: a CSV with the columns name, x, y, z (metres, or with a unit: 12 mm).

    Raises:
        CalibrationError: the file cannot be read, names a landmark twice or has none.
    """
    path = Path(path)
    try:
        table = pd.read_csv(path, dtype=str, skipinitialspace=True, encoding="utf-8-sig")
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, ValueError) as error:
        raise CalibrationError(f"{path}: is no CSV: {error}") from error
    table = table.rename(columns=str.strip).fillna("")
    missing = [name for name in ("name", *"xyz") if name not in table]
    if missing:
        raise CalibrationError(
            f"{path}: has no column {missing[0]}; its first line must be name,x,y,z"
        )
    named: dict[str, Array] = {}
    for row in table.to_dict("records"):
        name = row["name"].strip()
        if not name:
            raise CalibrationError(f"{path}: a landmark has no name; name all of them")
        if name in named:
            raise CalibrationError(f"{path}: landmark {name} is there twice; name each only once")
        try:
            named[name] = np.array([_LENGTH.parse(row[axis]) for axis in "xyz"])
        except ValueError as error:
            raise CalibrationError(f"{path}: landmark {name}: {error}") from error
    if not named:
        raise CalibrationError(f"{path}: holds no landmark")
    return named
