"""A recorded press: poses and wrenches paired by stamps, the sensor's delay, and poses to fit.

Tissue that is pressed slowly pushes back by how deep the probe is, no matter whether it goes in or
out. With wrenches that are late the force is too low on the way in and too high on the way out: the
curve of force over depth is a loop. The delay at which the loop is narrowest closes it.

A probe that is held adds nothing new, and neighbours in time share their errors. So poses are taken
at equal steps of the way that the probe goes in the tissue, not of time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from us_sim.errors import StiffnessError
from us_sim.geometry.pose import Pose

CHANNELS = ("force x", "force y", "force z", "torque x", "torque y", "torque z")
_FEWEST = 12  # Pairs of a pose and a wrench
# Of the largest force's change, and of that at a lever of so many m: a channel that changes less
# says nothing.
_SILENT, _LEVER = 1e-4, 0.01
_ALIKE = 0.5  # Part of the poses whose stamps must be those of wrenches: both then have one clock
_SLOPE_SPAN = 3  # Wrenches on each side over which its change with time is measured
Poses = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]
Wrenches = tuple[NDArray[np.int64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class PressRecord:
    """K poses of the probe and the wrench at each."""

    times: NDArray[np.float64]  # (K,) s, since the first pose of the recording
    positions: NDArray[np.float64]  # (K, 3) m, frame patient
    orientations: NDArray[np.float64]  # (K, 4) x, y, z, w
    wrenches: NDArray[np.float64]  # (K, 6) N and N m, on the probe about its origin, frame probe
    rates: NDArray[np.float64]  # (K, 6) of these, per second
    channels: NDArray[np.bool_]  # (6,), those that are measured: the others never change
    same_stamps: bool  # whether poses and wrenches were stamped alike, as us_sim does
    unpaired: int  # poses without a wrench near them

    def pose(self, index: int) -> Pose:
        """One pose of the probe."""
        return Pose(self.positions[index], self.orientations[index])

    def at(self, chosen: NDArray[np.integer]) -> PressRecord:
        """The record at some (K,) poses."""
        names = ("times", "positions", "orientations", "wrenches", "rates")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


def paired(
    poses: Poses, wrenches: Wrenches, *, tolerance: float, time_offset: float = 0.0
) -> PressRecord:
    """The wrench nearest in time to each pose, where one is near enough, taken on to its time.

    Args:
        poses: stamps (K,) ns, positions (K, 3) m, orientations (K, 4).
        wrenches: stamps (W,) ns, wrenches (W, 6) N and N m.
        tolerance: s, between a pose and its wrench.
        time_offset: s, by which the wrenches' stamps are late; they are taken back by it.

    Raises:
        StiffnessError: a wrench is not finite, none changes, or too few poses have
            one near them.
    """
    order = np.argsort(poses[0], kind="stable")
    stamps, positions, orientations = poses[0][order], poses[1][order], poses[2][order]
    felt_at, felt = in_order(wrenches)
    channels = _measured(felt)
    if not channels.any():
        raise StiffnessError(
            "the wrench never changes: the probe touched nothing, or the sensor was not read"
        )
    late = round(time_offset * 1e9)
    nearest = nearest_stamp(felt_at, stamps + late)
    apart = np.abs(felt_at[nearest] - stamps - late)
    near = apart <= round(tolerance * 1e9)
    if near.sum() < _FEWEST:
        raise StiffnessError(
            f"{int(near.sum())} of {len(stamps)} poses have a wrench within "
            f"{1e3 * tolerance:g} ms of them, and at least {_FEWEST} are needed: record both with "
            f"one clock, or say by how much the wrenches are late"
        )
    rates = _rates(felt_at, felt)[nearest[near]]
    early = (stamps + late - felt_at[nearest])[near] / 1e9
    return PressRecord(
        times=(stamps[near] - stamps[0]) / 1e9,
        positions=positions[near],
        orientations=orientations[near],
        wrenches=felt[nearest[near]] + early[:, None] * rates,
        rates=rates,
        channels=channels,
        same_stamps=stamped_alike(poses, wrenches) and late == 0,
        unpaired=int((~near).sum()),
    )


def without_wrench(poses: Poses) -> PressRecord:
    """A record of the poses alone, for landmarks."""
    order = np.argsort(poses[0], kind="stable")
    nothing = np.zeros((len(order), 6))
    return PressRecord(
        times=(poses[0][order] - poses[0][order[0]]) / 1e9,
        positions=poses[1][order],
        orientations=poses[2][order],
        wrenches=nothing,
        rates=nothing,
        channels=np.zeros(6, dtype=np.bool_),
        same_stamps=True,
        unpaired=0,
    )


def in_order(wrenches: Wrenches) -> Wrenches:
    """The wrenches in the order of their stamps, of equal stamps the one recorded last: a frame
    that was gone on with is sent again.

    Raises:
        StiffnessError: one is not finite.
    """
    _require_finite(wrenches[1])
    stamps, last = np.unique(wrenches[0][::-1], return_index=True)
    return stamps, np.asarray(wrenches[1], dtype=np.float64)[::-1][last]


def stamped_alike(poses: Poses, wrenches: Wrenches) -> bool:
    """Whether a wrench is made from a pose and has its stamp, as those of us_sim."""
    return bool(np.isin(poses[0], wrenches[0]).mean() > _ALIKE)


def nearest_stamp(stamps: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.intp]:
    """(K,) which of the ascending stamps is nearest to each that is wanted."""
    after = np.searchsorted(stamps, wanted)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(stamps) - 1)
    nearer = np.abs(stamps[before] - wanted) <= np.abs(stamps[after] - wanted)
    return np.where(nearer, before, after)


def _measured(felt: NDArray[np.float64]) -> NDArray[np.bool_]:
    largest = np.ptp(felt, axis=0)
    force = float(largest[:3].max())
    least = np.repeat([_SILENT * force, _SILENT * _LEVER * force], 3)
    return np.asarray((largest > least) & (largest > 0.0))


def _require_finite(felt: NDArray[np.float64]) -> None:
    bad = np.flatnonzero(~np.isfinite(felt).all(axis=1))
    if len(bad):
        raise StiffnessError(
            f"{len(bad)} of {len(felt)} wrenches are not finite, the first being number "
            f"{bad[0] + 1}: record the press anew, or leave that part of the recording out"
        )


def _rates(stamps: NDArray[np.int64], felt: NDArray[np.float64]) -> NDArray[np.float64]:
    """(W, 6) change of the wrenches per second, by a straight line through those around."""
    width = 2 * _SLOPE_SPAN + 1
    ends = (_SLOPE_SPAN, _SLOPE_SPAN)
    times = sliding_window_view(np.pad((stamps - stamps[0]) / 1e9, ends, "edge"), width)
    around = sliding_window_view(np.pad(felt, (ends, (0, 0)), "edge"), width, axis=0)
    since = times - times.mean(axis=1, keepdims=True)
    spread = np.maximum((since**2).sum(axis=1), np.finfo(np.float64).tiny)
    return np.asarray(np.einsum("wk,wck->wc", since, around) / spread[:, None])


_STEP = 0.01  # s, between delays that are tried; a parabola finds the least between them
_DEGREE = 4  # Of the polynomial that force is of depth
# Width of the loop at the largest delays over the narrowest, at least; and the width, over the
# force's variance, that is none.
_CLEAREST, _EXACT = 1.5, 1e-6
_FEWEST_COMPARED = 30  # Poses that are compared


def find_delay(
    poses: Poses, wrenches: Wrenches, clearance: Callable[[Pose], float], largest: float
) -> float:
    """s, by which the wrenches are late.

    Args:
        poses: stamps (K,) ns, positions (K, 3) m, orientations (K, 4).
        wrenches: stamps (W,) ns, wrenches (W, 6) N and N m.
        clearance: m, of a pose from the undeformed tissue, below zero in it.
        largest: s, the largest delay to look for, either way.

    Raises:
        StiffnessError: as `narrowest_loop`, or a wrench is not finite.
    """
    felt_at, felt = in_order(wrenches)
    depth = np.array([-clearance(Pose(p, q)) for p, q in zip(*poses[1:], strict=True)])
    free = felt[nearest_stamp(felt_at, poses[0])[depth <= 0.0], :3]
    tare = free.mean(axis=0) if len(free) else np.zeros(3)
    force = np.linalg.norm(felt[:, :3] - tare, axis=1)
    return narrowest_loop((poses[0], np.maximum(depth, 0.0)), (felt_at, force), largest)


def narrowest_loop(
    depth: tuple[NDArray[np.int64], NDArray[np.float64]],
    force: tuple[NDArray[np.int64], NDArray[np.float64]],
    largest: float,
) -> float:
    """s, by which the forces are late.

    Args:
        depth: stamps (K,) ns of the poses, and m, how deep the probe then is in the undeformed
            tissue.
        force: ascending stamps (W,) ns, and N.
        largest: s, the largest delay to look for, either way.

    Raises:
        StiffnessError: the recording is too short to look that far, or the loop is narrowest at
            the largest delay.
    """
    reach = round(1e9 * largest)
    inside = (depth[0] >= force[0][0] + reach) & (depth[0] <= force[0][-1] - reach)
    if inside.sum() < _FEWEST_COMPARED:
        raise StiffnessError(
            f"the recording is too short to look for a delay of {largest:g} s between poses and "
            f"wrenches: say by how much the wrenches are late"
        )
    at, deep = (depth[0][inside] - force[0][0]) / 1e9, depth[1][inside]
    felt_at = (force[0] - force[0][0]) / 1e9
    powers = np.vander(deep / (float(np.abs(deep).max()) or 1.0), _DEGREE + 1)

    def width(delay: float) -> float:
        """N2, the loop's."""
        felt = np.interp(at + delay, felt_at, force[1])
        curve = powers @ np.linalg.lstsq(powers, felt, rcond=None)[0]
        return float(((felt - curve) ** 2).mean())

    count = int(np.ceil(largest / _STEP))
    tried = largest / count * np.arange(-count, count + 1)
    widths = np.array([width(delay) for delay in tried])
    least = int(np.argmin(widths))
    clear = _CLEAREST * (widths[least] + _EXACT * float(np.var(force[1])))
    if not 0 < least < len(tried) - 1 or min(widths[0], widths[-1]) < clear:
        raise StiffnessError(
            f"wrenches and poses agree no better within {largest:g} s of each other: the press "
            f"has to go in and out, or say by how much the wrenches are late"
        )
    left, middle, right = widths[least - 1 : least + 2]
    bend = left - 2 * middle + right
    step = float(tried[1] - tried[0])
    return float(tried[least] + (0.5 * step * (left - right) / bend if bend > 0.0 else 0.0))


# m, clearance below which a probe presses, and above which it touches nothing; a pose between
# says little and costs as much.
_PRESSED, _FREE = -2e-4, 5e-4
# m, greatest depth of a press below which it is no more than the errors of a tracker.
_SHALLOWEST = 5e-4
_ARM = 0.02  # m, that a turn of the probe by one radian counts for
# Force without contact, over that with contact, which says that the two do not go together.
_STRAYING = 0.25
# Equal wrenches in a row, and the way (m) of the probe meanwhile, that no free sensor shows.
_SATURATED, _MOVED = 5, 2e-4


@dataclass(frozen=True, eq=False)
class ChosenPoses:
    """Numbers of poses of a record, in the order of time."""

    pressed: NDArray[np.intp]  # (K,)
    free: NDArray[np.intp]  # (F,), where the probe touches nothing; may be none
    clearance: NDArray[np.float64]  # (all poses,) m, from the undeformed tissue, below 0 inside


def choose_poses(
    record: PressRecord, clearance: Callable[[Pose], float], count: int
) -> ChosenPoses:
    """Poses that press the tissue, and as many that do not touch it, where there are some.

    Args:
        clearance: m, of a pose from the undeformed tissue.
        count: of poses that press, at most.

    Raises:
        StiffnessError: too few poses press the tissue, the sensor saturates, or forces are felt
            where nothing is touched.
    """
    apart = np.array([clearance(record.pose(k)) for k in range(len(record.times))])
    pressed, free = np.flatnonzero(apart < _PRESSED), np.flatnonzero(apart > _FREE)
    nearest = float(apart.min())
    if nearest > -_SHALLOWEST:
        where = (
            f"is {1e3 * nearest:.1f} mm away from it at its nearest"
            if nearest > 0
            else f"is {-1e3 * nearest:.2f} mm deep in it at its deepest"
        )
        raise StiffnessError(
            f"the probe does not press the tissue: it {where}; is the recording of this scene, and "
            f"its registration right?"
        )
    way = _way(record, pressed)
    chosen = pressed[evenly_spaced(way, count)]
    if len(chosen) < _FEWEST:
        raise StiffnessError(
            f"{len(chosen)} different poses press the tissue, and at least {_FEWEST} are needed: "
            f"record a press that goes in slowly, and out again"
        )
    _require_unsaturated(record, pressed)
    _require_agreement(record, pressed, free, apart)
    free = free[evenly_spaced(np.arange(len(free), dtype=np.float64), count)]
    return ChosenPoses(chosen, free, apart)


def evenly_spaced(way: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """At most ``count`` places in an ascending way (K,) that are as evenly spaced as can be."""
    if len(way) == 0:
        return np.zeros(0, np.intp)
    wanted = np.linspace(way[0], way[-1], count)
    after = np.clip(np.searchsorted(way, wanted), 1, max(len(way) - 1, 1))
    after = np.minimum(after, len(way) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(wanted - way[before] <= way[after] - wanted, before, after)
    return np.unique(nearest)


def _way(record: PressRecord, chosen: NDArray[np.intp]) -> NDArray[np.float64]:
    """(K,) m, that the probe has gone and turned until each pose, contact by contact."""
    moved = np.linalg.norm(np.diff(record.positions[chosen], axis=0), axis=1)
    unit = record.orientations[chosen]
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    cosine = np.clip(np.abs(np.einsum("ij,ij->i", unit[1:], unit[:-1])), 0.0, 1.0)
    steps = moved + _ARM * 2 * np.arccos(cosine)
    steps[np.diff(chosen) > 1] = 0.0  # the way between, without contact
    return np.concatenate([[0.0], np.cumsum(steps)])


def _require_agreement(
    record: PressRecord, pressed: NDArray, free: NDArray, apart: NDArray
) -> None:
    """Refuse forces that are felt where the tissue is not touched."""
    if len(free) < _FEWEST or not record.channels[:3].any():
        return
    tare = np.median(record.wrenches[free, :3], axis=0)
    force = np.linalg.norm(record.wrenches[:, :3] - tare, axis=1)
    felt, without = float(force[pressed].max()), np.percentile(force[free], 95)
    if without > _STRAYING * felt:
        far = 1e3 * float(apart[free].max())
        raise StiffnessError(
            f"the wrench changes by {without:.3g} N where the probe is up to {far:.1f} mm away "
            f"from the tissue, and by {felt:.3g} N where it presses: the two do not go together; "
            f"check the scene, the registration, and the sensor's clock and weight"
        )


def _require_unsaturated(record: PressRecord, pressed: NDArray[np.intp]) -> None:
    pressing = np.zeros(len(record.times) + 2, dtype=np.bool_)
    pressing[pressed + 1] = True
    for channel in np.flatnonzero(record.channels):
        values = record.wrenches[:, channel]
        for extreme in (values.min(), values.max()):
            at = pressing.copy()
            at[1:-1] &= values == extreme
            begins, ends = np.flatnonzero(np.diff(at.astype(int))).reshape(-1, 2).T
            for begin, end in zip(begins, ends, strict=True):
                way = float(np.ptp(record.positions[begin:end], axis=0).max())
                if end - begin >= _SATURATED and way > _MOVED:
                    unit = "N" if channel < 3 else "N m"
                    raise StiffnessError(
                        f"{CHANNELS[channel]} stays at {extreme:g} {unit} from "
                        f"{record.times[begin]:.2f} s to {record.times[end - 1]:.2f} s while the "
                        f"probe goes on by {1e3 * way:.1f} mm: the sensor saturates; press less, "
                        f"or set its range higher"
                    )
