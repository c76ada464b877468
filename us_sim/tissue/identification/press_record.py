"""A recorded press: where the probe was, and what it felt there, paired by stamps.

>>> import numpy as np
>>> from us_sim.tissue.identification.press_record import paired
>>> stamps = np.arange(40) * 16_666_667
>>> positions = np.column_stack([np.zeros((40, 2)), np.linspace(-0.005, 0.005, 40)])
>>> upright = np.tile([0.0, 0.0, 0.0, 1.0], (40, 1))
>>> felt = np.zeros((40, 6))
>>> felt[:, 2] = -np.maximum(positions[:, 2], 0.0) * 1000.0
>>> record = paired((stamps, positions, upright), (stamps + 2_000_000, felt), tolerance=0.01)
>>> len(record.times), record.channels.tolist(), record.same_stamps
(40, [False, False, True, False, False, False], False)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from us_sim.errors import StiffnessError
from us_sim.geometry.pose import Pose

CHANNELS = ("force x", "force y", "force z", "torque x", "torque y", "torque z")

_FEWEST = 12
"""Pairs of a pose and a wrench."""

_SILENT, _LEVER = 1e-4, 0.01
"""Of the largest force's change, and of that at a lever of so many m: a channel that changes less
says nothing."""

_ALIKE = 0.5
"""Part of the poses whose stamps must be those of wrenches: both then have one clock."""

_SLOPE_SPAN = 3
"""Wrenches on each side over which its change with time is measured."""

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
        """One of them."""
        return Pose(self.positions[index], self.orientations[index])

    def at(self, chosen: NDArray[np.integer]) -> PressRecord:
        """Some of them."""
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
    """(6,) which channels change."""
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
