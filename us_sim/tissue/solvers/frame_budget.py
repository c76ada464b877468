"""The time and the iterations that a frame of ``fem_nonlinear`` may take.

>>> from us_sim.tissue.solvers.frame_budget import FramePace
>>> pace = FramePace(sending=0.0005, cores=2)
>>> pace.count_frame(0.02)
>>> f"{1e3 * pace.limit:.1f} ms"
'10.7 ms'
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable

from us_sim.tissue.solvers.tuning import TUNING


class FrameBudget:
    """Says when a frame has to end; whatever is left of it goes on in the next.

    Args:
        clock: s.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._iteration_time = 0.0  # s, of the last step that was measured
        self.reset()

    def reset(self) -> None:
        """Restart the count of frames of a probe at rest."""
        self._frames_at_rest = 0

    def begin_frame(
        self,
        iterations: int,
        strict_limit: float | None = None,
        live_limit: float | None = None,
        *,
        moved: bool,
        restarted: bool = False,
    ) -> None:
        """Start the clock of a frame.

        Args:
            iterations: of conjugate gradients in a frame of a moving probe.
            strict_limit: s, that no frame may exceed, in place of the following.
            live_limit: s, for a simulation that has to keep up with its probe.
            moved: whether the probe has.
            restarted: whether the tissue begins anew from rest.
        """
        self._began = self._now = self._clock()
        self._frames_at_rest = 0 if moved else self._frames_at_rest + 1
        self._is_strict = strict_limit is not None
        self.time_limit = strict_limit or live_limit
        factor = TUNING.rest_factor if self._frames_at_rest else 1
        self._allowed = iterations * (TUNING.restart_factor if restarted else factor)
        self.iterations_left = self._allowed

    @property
    def is_hurried(self) -> bool:
        """True in a frame with a time limit that it must keep."""
        return self.time_limit is not None and self._frames_at_rest < TUNING.rest_frames

    @property
    def allows_load_step(self) -> bool:
        """True while time and iterations are left for a load step and the rest of the frame."""
        spent = self._allowed - self.iterations_left
        if spent > TUNING.load_step_iterations * self._allowed:
            return False
        return not self.is_late

    @property
    def is_late(self) -> bool:
        """True once the time that is left is for the pose itself, and no longer for load steps."""
        return self._iterations_within(TUNING.load_step_time) < TUNING.least_iterations

    def spend_iterations(self, iterations: int) -> None:
        """Subtract the iterations of a Newton step, and its fixed cost."""
        self.iterations_left -= iterations + TUNING.newton_step_cost

    def begin_step(self) -> None:
        """Begin to measure a Newton step."""
        self._now = self._clock()

    def end_step(self, iterations: int) -> None:
        """Call `spend_iterations`, and measure the time since `begin_step`."""
        self.spend_iterations(iterations)
        now = self._clock()
        self.step_time, self._now = now - self._now, now
        self._iteration_time = self.step_time / (iterations + TUNING.newton_step_cost)

    @property
    def step_iterations(self) -> int:
        """Iterations with which the next step ends in time, at the speed of the last one."""
        in_time = self._iterations_within(1.0)
        if in_time < TUNING.least_iterations and not self._is_strict:
            in_time = self._iterations_within(TUNING.overtime)
        return max(in_time, TUNING.least_iterations)

    def is_over(self, *, balanced: bool) -> bool:
        """Return whether another step would end late; a live frame out of balance has longer."""
        factor = 1.0 if balanced or self._is_strict else TUNING.overtime
        return self._iterations_within(factor) < TUNING.least_iterations

    def _iterations_within(self, factor: float) -> int:
        """Return the iterations of a step that ends after this many times the frame's time."""
        if self.time_limit is None:
            return sys.maxsize
        left = self._began + factor * self.time_limit - self._clock()
        return int(left / max(self._iteration_time, 1e-9)) - TUNING.newton_step_cost

    @property
    def is_shorter_than_a_step(self) -> bool:
        """True if the time limit that was set is shorter than the last Newton step took."""
        return self._is_strict and self.step_time > (self.time_limit or math.inf)


PERIOD = 1 / 60
"""s, from pose to pose."""
LEAST = 0.002
"""s, that every frame may take."""


class FramePace:
    """Time limit of each frame, so that poses at 60 Hz are kept up with.

    What a frame takes beyond a period is subtracted from the limits of those after it.

    Args:
        sending: s, that it takes to send a frame's result.
        cores: that the nodes of the simulation share; None are those this process may run on.
    """

    def __init__(self, sending: float, cores: int | None = None) -> None:
        # Of a period one node may use so much; the rest is for what else its core does.
        share = 0.87 if (cores or _usable_cores()) > 1 else 0.5
        self._undelayed = share * PERIOD - sending
        self.reset()

    def reset(self) -> None:
        """Begin with a pose that has not waited."""
        self._waited = 0.0  # s, from the coming of a pose to the begin of its frame

    @property
    def limit(self) -> float:
        """s, that the next frame may take."""
        return max(self._undelayed - self._waited, LEAST)

    def count_frame(self, duration: float) -> None:
        """Count a frame that took so long (s), with sending it."""
        self._waited = min(max(0.0, self._waited + duration - PERIOD), PERIOD)


def _usable_cores() -> int:
    """Return how many cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def time_shortest_run(work: Callable[[], object]) -> float:
    """Return the time (s, on the wall) of the shortest of five runs of ``work``."""
    times = []
    for _ in range(5):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)
