"""Making the next solver in a thread, while the present one goes on deforming the tissue."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass

from us_sim.errors import UsSimError
from us_sim.tissue.solvers.switching import Plan, Prepared, SwitchableTissue

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Failed:
    """A plan that cannot be carried out, and why."""

    plan: Plan
    problem: str


class Preparation:
    """Makes what a plan needs in a thread; the newest plan wins.

    Args:
        tissue: that goes on meanwhile, and that adopts what was made.
    """

    def __init__(self, tissue: SwitchableTissue) -> None:
        self._tissue = tissue
        self._lock = threading.Lock()
        self._wanted: Plan | None = None  # that no thread has begun with
        self._newest: Plan | None = None
        self._outcome: Prepared | Failed | None = None
        self._thread: threading.Thread | None = None
        self._began = 0.0
        self._progress = ""

    @property
    def state(self) -> str:
        """What is being made, for how long already, and how far it is; '' when nothing is."""
        with self._lock:
            if self._thread is None or self._newest is None:
                return ""
            seconds = time.monotonic() - self._began
            return f"preparing {self._newest.reason} for {seconds:.0f} s{self._progress}"

    def want(self, plan: Plan) -> None:
        """Begin to make what a plan needs; what is still being made for another is then dropped."""
        with self._lock:
            self._wanted = self._newest = plan
            self._outcome = None
            if self._thread is None:
                self._began = time.monotonic()
                self._thread = threading.Thread(target=self._work, name="solver", daemon=True)
                self._thread.start()

    def drop(self) -> None:
        """Want nothing any more; a thread ends with what it is making."""
        with self._lock:
            self._wanted = self._newest = self._outcome = None

    def take(self) -> Prepared | Failed | None:
        """The outcome of the newest plan, once; None until there is one."""
        with self._lock:
            outcome, self._outcome = self._outcome, None
            return outcome

    def _show(self, fraction: float, text: str) -> None:
        with self._lock:
            share = f"{100 * fraction:.0f} % of " if fraction > 0.0 else ""
            self._progress = f", {share}{text}"

    def _work(self) -> None:
        while True:
            with self._lock:
                plan, self._wanted, self._progress = self._wanted, None, ""
                if plan is None:
                    self._thread = None
                    return
            outcome: Prepared | Failed
            try:
                outcome = self._tissue.make(plan, self._show, beside=True)
            except UsSimError as error:
                outcome = Failed(plan, str(error))
            except Exception as error:  # so that the thread does not end silently
                _logger.exception("preparing %s", plan.solver)
                outcome = Failed(plan, f"{type(error).__name__}: {error}")
            with self._lock:
                if self._newest is plan:
                    self._outcome = outcome
