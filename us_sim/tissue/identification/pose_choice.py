"""Which poses of a recorded press are looked at: spread over its way, not over its time.

A probe that is held adds nothing new, and neighbours in time share their errors. So poses are taken
at equal steps of the way that the probe goes in the tissue.

>>> import numpy as np
>>> from us_sim.tissue.identification.pose_choice import spread
>>> held = np.concatenate([np.linspace(0, 1, 11), np.full(80, 1.0), np.linspace(1, 0, 11)])
>>> spread(np.concatenate([[0.0], np.cumsum(np.abs(np.diff(held)))]), 5).tolist()
[0, 5, 91, 96, 101]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import StiffnessError
from us_sim.geometry.pose import Pose
from us_sim.tissue.identification.press_record import CHANNELS, PressRecord

_PRESSED, _FREE = -2e-4, 5e-4
"""m, clearance below which a probe presses, and above which it touches nothing; a pose between says
little and costs as much."""

_FEWEST = 12
"""Poses that press, of which intervals can be stated."""

_SHALLOWEST = 5e-4
"""m, greatest depth of a press below which it is no more than the errors of a tracker."""

_ARM = 0.02
"""m, that a turn of the probe by one radian counts for."""

_STRAYING = 0.25
"""Force without contact, over that with contact, which says that the two do not go together."""


_SATURATED, _MOVED = 5, 2e-4
"""Equal wrenches in a row, and the way (m) of the probe meanwhile, that no free sensor shows."""


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
        record: the press.
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
    chosen = pressed[spread(way, count)]
    if len(chosen) < _FEWEST:
        raise StiffnessError(
            f"{len(chosen)} different poses press the tissue, and at least {_FEWEST} are needed: "
            f"record a press that goes in slowly, and out again"
        )
    _require_unsaturated(record, pressed)
    _require_agreement(record, pressed, free, apart)
    free = free[spread(np.arange(len(free), dtype=np.float64), count)]
    return ChosenPoses(chosen, free, apart)


def spread(way: NDArray[np.float64], count: int) -> NDArray[np.intp]:
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
    record: PressRecord,
    pressed: NDArray[np.intp],
    free: NDArray[np.intp],
    apart: NDArray[np.float64],
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
    """Refuse a channel that stays at its extreme while the probe goes on in the tissue."""
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
