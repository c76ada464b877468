"""How far an image reaches beyond what there is to see.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.reach import beyond
>>> arm = np.array([[-0.036, -0.03, 0.0], [0.036, 0.03, 0.054]])
>>> round(beyond(LinearProbe(aperture=0.04, depth=0.1), Pose([0.0, 0.0, 0.004]), arm), 6)
0.05
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.probe import Probe


def beyond(probe: Probe, pose: Pose, extent: NDArray[np.float64]) -> float:
    """m of the middle beam that lie behind a box; 0 where it ends within it or never enters it.

    Args:
        extent: (2, 3) m, lower and upper corner of the box in the pose's parent frame.
    """
    direction = pose.rotation[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = (extent - pose.position) / direction
    entered, left = np.nanmax(distances.min(axis=0)), np.nanmin(distances.max(axis=0))
    if not (entered < left and left > 0.0 and entered < probe.depth):
        return 0.0
    return max(0.0, float(probe.depth - left))
