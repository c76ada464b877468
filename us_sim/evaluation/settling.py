"""When a tissue under a probe at rest has come to rest itself.

>>> from us_sim.evaluation.settling import frames_until
>>> frames_until([1.0, 1e-4, 0.5, 9e-4, 1e-6], 1e-3), frames_until([1.0], 1e-3)
(3, None)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def frames_until(residual: Sequence[float] | NDArray[np.float64], small: float) -> int | None:
    """After how many frames a residual is as small as asked and stays so; None where it is not.

    The first residual is that of the frame before, so that none is needed where it is small.
    """
    large = np.flatnonzero(~(np.asarray(residual) <= small))
    after = int(large[-1]) + 1 if len(large) else 0
    return after if after < len(residual) else None
