"""How long each run of a method took.

>>> import numpy as np
>>> from us_sim.evaluation.run_times import RunTimes
>>> times = RunTimes(np.arange(1.0, 102.0))
>>> times.median, times.p99
(51.0, 100.0)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class RunTimes:
    """The wall clock of runs, one after another."""

    milliseconds: NDArray[np.float64]  # (R,) of each

    @property
    def median(self) -> float:
        """ms, of a run."""
        return float(np.median(self.milliseconds))

    @property
    def p99(self) -> float:
        """ms, which one run in a hundred exceeds."""
        return float(np.percentile(self.milliseconds, 99))
