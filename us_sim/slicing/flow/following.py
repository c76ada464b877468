"""The vessel nearest to a place of the image, for a gate or a colour box that follows it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.flow.blood import Blood, Window
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.beam_places import fractions_and_depths, pixels_of
from us_sim.slicing.probe.probe import LinearProbe

_STEP = 6  # pixels from one place that is looked at to the next
_REACH = 8e-3  # m around the nearest place of a vessel, which may cross the image twice


def nearest_vessel(
    blood: Blood, frame: Frame, lateral: float, depth: float, steering: float = 0.0
) -> tuple[float, float] | None:
    """Where the middle is, in the image, of the lumen nearest to a place; None without any.

    Args:
        blood: in the vessels.
        lateral, depth: of the place, fraction of the face and m, as of `pixels_of`.
        steering: rad, of beams that lead to places.
    """
    probe = frame.probe
    columns, rows = np.arange(0, probe.columns, _STEP), np.arange(0, probe.rows, _STEP)
    grid: NDArray[np.float64] = np.stack(np.meshgrid(columns, rows), axis=-1).astype(float)
    window = Window(probe, np.zeros(grid.shape[:2]), grid)
    _, which = blood.mean_velocities(frame, window)
    here = pixels_of(probe, np.array([lateral]), np.array([depth]), steering)[0]
    far = np.linalg.norm((grid - here) * probe.pixel_spacing, axis=-1)
    far[which < 0] = np.inf
    if not np.isfinite(far).any():
        return None
    nearest = np.unravel_index(np.argmin(far), far.shape)
    beside = np.linalg.norm((grid - grid[nearest]) * probe.pixel_spacing, axis=-1) < _REACH
    column, row = np.rint(grid[beside & (which == which[nearest])].mean(axis=0)).astype(int)
    fractions, depths = fractions_and_depths(probe)
    across, down = float(fractions[row, column]), float(depths[row, column])
    if isinstance(probe, LinearProbe) and steering != 0.0:
        across -= down * math.tan(steering) / probe.aperture
        down /= math.cos(steering)
    return (across, down) if math.isfinite(across) else None
