"""By how much a force sensor's stamps are late, from loading and unloading.

Tissue that is pressed slowly pushes back by how deep the probe is, no matter whether it goes in or
out. With wrenches that are late the force is too low on the way in and too high on the way out: the
curve of force over depth is a loop. The delay at which the loop is narrowest closes it.

>>> import numpy as np
>>> from us_sim.tissue.identification.wrench_delay import narrowest_loop
>>> times = np.arange(0.0, 6.0, 1 / 60)
>>> def depth(t):
...     return 0.01 * np.sin(np.pi * t / 3) ** 2
>>> stamps, late = np.round(1e9 * times).astype(np.int64), 1e5 * depth(times - 0.04) ** 2
>>> round(narrowest_loop((stamps, depth(times)), (stamps, late), largest=0.3), 3)
0.04
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import StiffnessError
from us_sim.geometry.pose import Pose
from us_sim.tissue.identification.press_record import Poses, Wrenches, in_order, nearest_stamp

_STEP = 0.01
"""s, between delays that are tried; a parabola finds the least between them."""

_DEGREE = 4
"""Of the polynomial that force is of depth."""

_CLEAREST, _EXACT = 1.5, 1e-6
"""Width of the loop at the largest delays over the narrowest, at least; and the width, over the
force's variance, that is none."""

_FEWEST = 30
"""Poses that are compared."""


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
    if inside.sum() < _FEWEST:
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
