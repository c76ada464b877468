"""Depth along a probe's beams, and the width of a beam there, for all parts of image formation.

>>> from us_sim.slicing.probe.beams import beam_width
>>> round(float(beam_width(0.0, 2e-3, focus=0.02)) * 1e3, 3)  # mm, at the face
2.828
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.slicing.probe.probe import Probe

DEPTH_STEPS = 512
"""Steps of depth in which tables of what changes with depth are made."""


def focus_of(probe: Probe) -> float:
    """Depth of the focus along the beams, m; half the image's depth where the probe has none."""
    return 0.5 * probe.depth if probe.focus is None else probe.focus


def beam_width(depth: ArrayLike, width: float, focus: float) -> NDArray[Any]:
    """Width of a beam at depths (any shape) m, that is ``width`` at its focus.

    It grows on both sides as that of a Gaussian beam, here √2 times at the face and at twice the
    focal depth: the range of an aperture that is weakly focused.
    """
    return np.asarray(width * np.hypot(1.0, (np.asarray(depth) - focus) / focus))


def step_depths(probe: Probe) -> NDArray[Any]:
    """(`DEPTH_STEPS`,) m: the depth along the beams in the middle of each step."""
    return np.asarray((np.arange(DEPTH_STEPS) + 0.5) * (probe.depth / DEPTH_STEPS))


def depth_steps(probe: Probe) -> NDArray[np.uint16]:
    """(rows, columns): the step of depth that each pixel lies in; 0 where no beam reaches."""
    step = probe.pixel_beams[1] * np.float32(DEPTH_STEPS / probe.depth)
    np.nan_to_num(step, copy=False)
    return np.clip(step, 0, DEPTH_STEPS - 1, out=step).astype(np.uint16)
