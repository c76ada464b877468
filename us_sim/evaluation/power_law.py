"""How a cost grows with a size.

>>> from us_sim.evaluation.power_law import exponent
>>> round(exponent({10: 2.0, 20: 8.0, 40: 32.0}), 3)
2.0
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


def exponent(cost_of_size: Mapping[float, float]) -> float:
    """k in cost ~ size^k, by least squares of the logarithms; NaN with fewer than two sizes.

    Costs that are not positive and finite are left out.
    """
    known = {n: cost for n, cost in cost_of_size.items() if np.isfinite(cost) and cost > 0}
    if len(known) < 2:
        return float("nan")
    return float(np.polyfit(np.log(list(known)), np.log(list(known.values())), 1)[0])
