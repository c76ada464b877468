"""Places on a probe's beams: fractions of its face, depths, and the width of a beam there.

A place across the array is a fraction: -0.5 at its first end, 0.5 at its other, of the face of a
linear array and of the opening angle where beams spread.

>>> import numpy as np
>>> from us_sim.slicing.probe.beams import convert_to_pixels
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=80, rows=80)
>>> convert_to_pixels(probe, np.array([0.0, 0.25]), np.full(2, 0.02)).round(6)  # column and row
array([[39.5, 39.5],
       [59.5, 39.5]])
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import ProbeError
from us_sim.slicing.probe.probe import LinearProbe, Probe

DEPTH_STEPS = 512  # steps of depth in which tables of what changes with depth are made


def get_focus(probe: Probe) -> float:
    """Return the depth of focus along the beams, m; half the image's where the probe has none."""
    return 0.5 * probe.depth if probe.focus is None else probe.focus


def compute_beam_width(depth: ArrayLike, width: float, focus: float) -> NDArray[Any]:
    """Compute the width of a beam at depths (any shape) m, that is ``width`` at its focus.

    It grows on both sides as that of a Gaussian beam, here √2 times at the face and at twice the
    focal depth: the range of an aperture that is weakly focused.
    """
    return np.asarray(width * np.hypot(1.0, (np.asarray(depth) - focus) / focus))


def compute_step_depths(probe: Probe) -> NDArray[Any]:
    """Return (`DEPTH_STEPS`,) m: the depth along the beams in the middle of each step."""
    return np.asarray((np.arange(DEPTH_STEPS) + 0.5) * (probe.depth / DEPTH_STEPS))


def find_depth_steps(probe: Probe) -> NDArray[np.uint16]:
    """Return (rows, columns): the step of depth of each pixel; 0 where no beam reaches."""
    step = probe.pixel_beams[1] * np.float32(DEPTH_STEPS / probe.depth)
    np.nan_to_num(step, copy=False)
    return np.clip(step, 0, DEPTH_STEPS - 1, out=step).astype(np.uint16)


def require_depth(probe: Probe, key: str, depth: float | None, what: str) -> float:
    """Return the depth, m, or half of the image's where none is given.

    Raises:
        ProbeError: it lies outside the image.
    """
    if depth is None:
        return 0.5 * probe.depth
    if depth >= probe.depth:
        raise ProbeError(
            f"{key}: {what} at {1e3 * depth:g} mm lies outside the image, which is "
            f"{1e3 * probe.depth:g} mm deep"
        )
    return depth


def require_steering(probe: Probe, key: str, steering: float) -> None:
    """Refuse to steer a probe that cannot.

    Raises:
        ProbeError: its beams spread, and it shall.
    """
    if steering != 0.0 and not isinstance(probe, LinearProbe):
        raise ProbeError(f"{key}: is for linear probes only: beams of this one spread, so give 0")


def compute_beam_angles(
    probe: Probe, fraction: NDArray[Any], steering: float = 0.0
) -> NDArray[np.float64]:
    """Return angles (as ``fraction``) rad of the beams there from the probe's z towards its x."""
    directions = probe.beam_directions
    angles = np.arctan2(directions[:, 0], directions[:, 1])
    return np.asarray(_interpolate_lines(probe, fraction, angles) + steering)


def convert_to_pixels(
    probe: Probe, fraction: NDArray[Any], depth: NDArray[Any], steering: float = 0.0
) -> NDArray[np.float64]:
    """Convert places (P,) along beams to (P, 2) fractional column and row.

    Args:
        probe: whose beams they are.
        fraction: of the beam's start.
        depth: m, along the beam.
        steering: rad, of all beams.
    """
    angle = compute_beam_angles(probe, fraction, steering)
    x = _interpolate_lines(probe, fraction, probe.beam_starts[:, 0]) + depth * np.sin(angle)
    z = _interpolate_lines(probe, fraction, probe.beam_starts[:, 1]) + depth * np.cos(angle)
    matrix = probe.image_to_probe
    return np.stack([(x - matrix[0, 3]) / matrix[0, 0], (z - matrix[2, 3]) / matrix[2, 1]], axis=-1)


def compute_beam_coordinates(probe: Probe) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return face fraction and depth (m) of each pixel (rows, columns); NaN beside the beams.

    Beams are not steered.
    """
    line, depth = probe.pixel_beams
    return (line + np.float32(0.5)) / np.float32(probe.lines) - np.float32(0.5), depth


def _interpolate_lines(
    probe: Probe, fraction: NDArray[Any], of_lines: NDArray[np.float64]
) -> NDArray[Any]:
    """Interpolate values of lines linearly, and on beyond the outermost two."""
    if probe.lines == 1:
        return np.full(np.shape(fraction), of_lines[0])
    line = (np.asarray(fraction) + 0.5) * probe.lines - 0.5
    low = np.clip(np.nan_to_num(line), 0, probe.lines - 2).astype(int)
    return np.asarray(of_lines[low] + (line - low) * (of_lines[low + 1] - of_lines[low]))
