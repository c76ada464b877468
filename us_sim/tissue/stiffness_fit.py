"""Young's moduli of structures from a recorded press: least squares over `fem_nonlinear`.

The logarithms of the moduli are found with which the tissue pushes back as was measured
(`scipy.optimize.least_squares`). The sensor's offset is the mean of what is left over. Errors of
neighbouring poses are alike, so intervals come from leaving out one part of the press after the
other (block jackknife; H. R. Künsch, The jackknife and the bootstrap for general stationary
observations, Ann. Statist. 17, 1989), and are no narrower than those of independent errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import t as student

from us_sim import Progress
from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.tissue.contact.probe_gap import measure_gaps
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear

FARTHEST = 100.0
"""Factor by which a modulus may differ from the one that the fit begins with."""
FEWEST = 12
"""Poses that must press the tissue."""
_LEVER = 0.02  # m, by which torques are divided, to count beside forces
_STEP = 0.002  # of a modulus' logarithm, relative, to the press whose difference is its slope
_PARTS = 8  # of the press, of which one is left out at a time
_FRAMES, _BALANCED = 200, 1e-3  # frames for a pose at most, and the residual with which it must end
_PRESSED = 2e-4  # m, depth from which on a probe presses


@dataclass(frozen=True)
class StiffnessSettings(Settings):
    """Young's moduli from a press: each field is an option of ``us-sim fit-stiffness``."""

    error = CalibrationError

    keep: tuple[str, ...] = setting(
        description="structures whose modulus stays as the scene says", default=()
    )
    poses: int = setting(
        Quantity("number", FEWEST, 2000), "of the press that are looked at, at most", default=32
    )
    pose: str = setting(
        description="topic of the probe's poses in the patient", default="probe/pose"
    )
    wrench: str = setting(
        description="topic of the force and torque on the probe", default="probe/wrench"
    )
    tolerance: float = setting(
        Quantity("time", 1e-4, 1.0), "between a pose and its wrench", default=0.01
    )
    time_offset: float = setting(
        Quantity("time", -10.0, 10.0), "by which the wrenches' stamps are late", default=0.0
    )
    widest: float = setting(
        Quantity("number", 1.05, 100.0),
        "factor of an interval either way, beyond which a modulus counts as not determined",
        default=3.0,
    )
    out: Path = setting(
        description="file to write: a scene with these moduli; a picture goes beside it",
        default=Path("stiffness.yaml"),
    )

    def check(self) -> None:
        """Refuse files that exist, before the work."""
        self.require_new_file("out", ".yaml", ".yml", picture=True)


@dataclass(frozen=True, eq=False)
class RecordedPress:
    """Poses of the probe, and what it felt."""

    times: NDArray[np.float64]  # (K,) s
    poses: Sequence[Pose]  # K, frame patient
    wrenches: NDArray[np.float64]  # (K, 6) N and N m, on the probe about its origin, frame probe


@dataclass(frozen=True, eq=False)
class StiffnessFit:
    """Moduli, how well they are known, and how they explain the press."""

    moduli: Mapping[str, float]  # Pa, of all structures
    factors: Mapping[str, float]  # of the fitted: their 95 % interval either way
    press: RecordedPress  # the poses that were looked at
    depths: NDArray[np.float64]  # (K,) m
    left: NDArray[np.float64]  # (K, 6) N and N m, measured less modelled and the offset
    offset: NDArray[np.float64]  # (6,) N and N m


def pair_press(
    stamps: NDArray[np.int64],
    poses: Sequence[Pose],
    felt_at: NDArray[np.int64],
    wrenches: NDArray[np.float64],
    settings: StiffnessSettings,
) -> RecordedPress:
    """Pair poses with the wrench that is nearest in time.

    Args:
        stamps: (K,) ns of the poses.
        poses: K, frame patient.
        felt_at: (W,) ns of the wrenches.
        wrenches: (W, 6) N and N m.
        settings: the tolerance, and by how much wrenches are late.

    Raises:
        CalibrationError: too few poses have a wrench, one is not finite, or all are the same.
    """
    if not np.isfinite(wrenches).all():
        raise CalibrationError("a wrench is not finite: leave that part of the recording out")
    if not np.ptp(wrenches, axis=0).any():
        raise CalibrationError("the wrench never changes: was the sensor read?")
    order = np.argsort(felt_at, kind="stable")
    wanted = stamps + round(1e9 * settings.time_offset)
    after = np.clip(np.searchsorted(felt_at[order], wanted), 1, len(order) - 1)
    earlier, later = order[after - 1], order[after]
    nearest = np.where(wanted - felt_at[earlier] < felt_at[later] - wanted, earlier, later)
    near = np.flatnonzero(np.abs(felt_at[nearest] - wanted) <= round(1e9 * settings.tolerance))
    if len(near) < FEWEST:
        raise CalibrationError(
            f"{len(near)} of {len(stamps)} poses have a wrench within "
            f"{1e3 * settings.tolerance:g} ms, and {FEWEST} are needed: record both with one clock"
        )
    times = (stamps[near] - stamps[0]) / 1e9
    return RecordedPress(times, [poses[k] for k in near.tolist()], wrenches[nearest[near]])


def fit_stiffness(
    model: TissueModel,
    constants: Callable[[Mapping[str, float]], TissueMaterials],
    moduli: Mapping[str, float],
    press: RecordedPress,
    settings: StiffnessSettings,
    progress: Progress | None = None,
) -> StiffnessFit:
    """Find the moduli that explain a press best.

    Args:
        model: the tissue and the probe.
        constants: makes those of the tetrahedra from moduli (Pa) by structure.
        moduli: Pa, of all structures, to begin with.
        press: the recording.
        settings: what to keep, how many poses, how wide an interval may be.
        progress: called with the fraction done of a press, and the misfit.

    Raises:
        CalibrationError: the press does not determine a modulus, or is not one of this tissue.
        SolverError: the tissue cannot be solved.
    """
    names = [name for name in moduli if name not in settings.keep]
    if not names or not set(settings.keep) <= set(moduli):
        raise CalibrationError(f"--keep: name some of {', '.join(moduli)}, and not all")
    depths = np.array([_depth(model, pose) for pose in press.poses])
    chosen = _choose_poses(depths, settings.poses)
    poses = [press.poses[k] for k in chosen.tolist()]
    press = RecordedPress(press.times[chosen], poses, press.wrenches[chosen])
    depths = np.maximum(depths[chosen], 0.0)
    lever = np.repeat([1.0, _LEVER], 3)
    state = {"misfit": ""}

    def left_over(logarithms: NDArray[np.float64]) -> NDArray[np.float64]:
        tried = {**moduli, **dict(zip(names, np.exp(logarithms).tolist(), strict=True))}
        pressed = replace(model, materials=constants(tried))
        modelled = simulate_wrenches(pressed, press.poses, depths, _titled(progress, state))
        if modelled[:, 2] @ (press.wrenches[:, 2] - press.wrenches[:, 2].mean()) < 0.0:
            raise CalibrationError(
                "the wrench points the other way: along z the force on the probe falls below zero "
                "when it is pressed in; turn the sensor's sign"
            )
        left = press.wrenches - modelled
        misfit = (left - left.mean(axis=0)) / lever
        state["misfit"] = f"misfit {np.sqrt((misfit**2).mean()):.3g} N"
        return np.asarray(misfit.ravel())

    start = np.log([moduli[name] for name in names])
    reach = np.log(FARTHEST)
    found = least_squares(
        left_over, start, bounds=(start - reach, start + reach), diff_step=_STEP, xtol=1e-4
    )
    widths = compute_half_widths(found.jac, found.fun)
    wide = [
        name for name, width in zip(names, widths, strict=True) if width > np.log(settings.widest)
    ]
    if wide:
        raise CalibrationError(
            f"this press does not determine {', '.join(wide)}: press deeper, from other sides or "
            f"nearer to it, or keep the scene's with --keep {' '.join(wide)}"
        )
    ends = [name for name, on in zip(names, found.active_mask, strict=True) if on]
    if ends:
        raise CalibrationError(
            f"{', '.join(ends)}: runs to {FARTHEST:g} times what the scene says, or that part of "
            f"it: check the registration and the sensor's units, or --keep {' '.join(ends)}"
        )
    fitted = dict(zip(names, np.exp(found.x).tolist(), strict=True))
    left = found.fun.reshape(-1, 6) * lever
    modelled = simulate_wrenches(
        replace(model, materials=constants({**moduli, **fitted})), press.poses, depths
    )
    return StiffnessFit(
        {**moduli, **fitted},
        dict(zip(names, np.exp(widths).tolist(), strict=True)),
        press,
        depths,
        left,
        (press.wrenches - modelled).mean(axis=0),
    )


def simulate_wrenches(
    model: TissueModel,
    poses: Sequence[Pose],
    depths: NDArray[np.float64],
    progress: Progress | None = None,
) -> NDArray[np.float64]:
    """Simulate the wrenches (K, 6) N and N m on the probe, in its frame, at poses.

    ``depths`` (K,) m are those in the tissue at rest.

    Raises:
        CalibrationError: the tissue does not come to balance at a pose.
    """
    solver, wrenches = FemNonlinear(model), np.zeros((len(poses), 6))
    for k in np.flatnonzero(depths > 0.0).tolist():
        if progress is not None:
            progress(k / len(poses), "pressing")
        for _ in range(_FRAMES):
            deformation = solver.deform(poses[k])
            if solver.is_settled:
                break
        if not deformation.residual <= _BALANCED:
            raise CalibrationError(
                f"the tissue does not come to balance {1e3 * depths[k]:.1f} mm deep: is the press "
                f"deeper than tissue yields, or the mesh too coarse for it?"
            )
        wrenches[k] = np.concatenate([deformation.force, deformation.torque])
    return wrenches


def compute_half_widths(
    slopes: NDArray[np.float64], left: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (P,) half of the 95 % intervals of unknowns with slopes (n, P), residuals (n,)."""
    normal = slopes.T @ slopes
    ridge = 1e-12 * np.trace(normal) * np.eye(len(normal))  # makes what is not felt very wide
    variance = left @ left / (len(left) - len(normal)) * np.diag(np.linalg.inv(normal + ridge))
    part = np.arange(len(left)) * _PARTS // len(left)
    without = np.array(
        [np.linalg.lstsq(slopes[part != k], left[part != k], rcond=None)[0] for k in range(_PARTS)]
    )
    by_parts = (_PARTS - 1) * without.var(axis=0)
    return np.asarray(student.ppf(0.975, _PARTS - 1) * np.sqrt(np.maximum(variance, by_parts)))


def _depth(model: TissueModel, pose: Pose) -> float:
    """Return the depth (m) of the probe in the tissue at rest; below zero outside."""
    touched = model.mesh.nodes[model.contact_nodes]
    return -float(measure_gaps(model.collider, pose, touched, model.contact_spacing)[0].min())


def _choose_poses(depths: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """Choose poses in the order of time: as many in the tissue as without contact.

    Raises:
        CalibrationError: too few press the tissue.
    """
    pressed, free = np.flatnonzero(depths > _PRESSED), np.flatnonzero(depths < 0.0)
    if len(pressed) < FEWEST:
        raise CalibrationError(
            f"{len(pressed)} poses press the tissue, and {FEWEST} are needed (the deepest is "
            f"{1e3 * depths.max():.1f} mm, below zero outside): is the recording of this scene, "
            f"and its registration right?"
        )
    some = [
        each[np.linspace(0, len(each) - 1, count).astype(int)]
        for each in (pressed, free)
        if len(each)
    ]
    return np.unique(np.concatenate(some))


def _titled(progress: Progress | None, state: Mapping[str, str]) -> Progress | None:
    return None if progress is None else lambda done, _: progress(done, state["misfit"])
