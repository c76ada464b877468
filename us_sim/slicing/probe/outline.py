"""The outline of what a probe's image shows, for the eye.

>>> from us_sim.slicing.probe.outline import image_outline
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> image_outline(LinearProbe(aperture=0.04, depth=0.05), points=2) * 1e3
array([[-20.,   0.,   0.],
       [ 20.,   0.,   0.],
       [ 20.,   0.,  50.],
       [-20.,   0.,  50.]])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.probe.probe import Probe

OUTLINE_POINTS = 33
"""Of each of the two arcs that an outline has."""


def image_outline(probe: Probe, points: int = OUTLINE_POINTS) -> NDArray[np.float64]:
    """(2 points, 3) m in frame ``probe``: along the face, then back where the image ends.

    So the beam of point k ends at the point 2 points - 1 - k.
    """
    starts, directions = probe.rays(np.linspace(0.0, 1.0, points))
    ends = starts + probe.depth * directions
    outline = np.zeros((2 * points, 3))
    outline[:, [0, 2]] = np.concatenate([starts, ends[::-1]])
    return outline
