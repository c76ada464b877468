"""`us-sim evaluate hand`: how tissue follows a hand, with every method.

Random motions of a hand (`us_sim.recording.hand_motion`) on several tissues are followed with every
pose, and live, where a frame that takes too long costs poses; then the probe is held still. What is
compared is where the nodes are with the converged answer at the same pose
(`us_sim.evaluation.hand.converged`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from us_sim.evaluation.hand.cases import TISSUES, Motion, motions
from us_sim.evaluation.hand.converged import METHOD, Converged, converged, patient_solver
from us_sim.evaluation.hand.points import Point, measure
from us_sim.evaluation.hand.report import table, write_report
from us_sim.evaluation.hand.settings import HandSettings
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures, words_of
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.progress import Progress
from us_sim.tissue.solvers.solver import TissueSolver, create_solver


def evaluate_hand(out: Path, quick: bool, settings: HandSettings | None = None) -> int:
    """Write hand.csv, the plots and hand.md, as `us_sim.evaluation` says.

    A quick run has fewer and shorter motions.
    """
    folder = ReportFolder("hand", out, quick)
    planned = motions(quick, (settings or HandSettings()).seed)
    answers: dict[Motion, Converged] = {}
    runs = sum(len(motion.poses) for motion in planned) * (1 + len(TISSUE_METHODS))
    with Progress("hand", runs, "poses") as progress, threadpool_limits(1):
        points = list(_points(planned, answers, progress.update))
        progress.update(runs)
    folder.write_rows("hand", points)
    write_report(folder, points, answers)
    return folder.finish(table(points), failures(points))


def _points(
    planned: Sequence[Motion],
    answers: dict[Motion, Converged],
    progress: Callable[[float, str], None],
) -> Iterator[Point]:
    """Every motion with every method; what has converged at its poses is put into ``answers``."""
    done = 0
    bench = _Bench()
    for motion in planned:
        for method in (None, *TISSUE_METHODS):
            before, words = done, f"{motion}: {method or 'the converged answer'}"
            progress(before, words)

            def tell(count: int, before: int = before, words: str = words) -> None:
                progress(before + count, words)

            if method is None:
                answers[motion] = bench.answer(motion, tell)
            else:
                yield bench.point(motion, method, answers[motion], tell)
            done += len(motion.poses)


class _Bench:
    """Keeps the last tissue's solvers."""

    def __init__(self) -> None:
        self._tissue = ""
        self._solvers: dict[str, TissueSolver] = {}
        self._patient: TissueSolver | None = None
        self._broken: dict[Motion, str] = {}

    def answer(self, motion: Motion, progress: Callable[[int], None]) -> Converged:
        """The converged answer; where there is none, that of no frame."""
        try:
            return converged(TISSUES[motion.tissue].model, motion.poses, progress)
        # Whatever breaks on one tissue must not take the others' results along.
        except Exception as error:
            self._broken[motion] = f"the converged answer with {METHOD}: {words_of(error)}"
            return Converged.of_no_frame(len(motion.poses))

    def point(
        self, motion: Motion, method: str, answer: Converged, progress: Callable[[int], None]
    ) -> Point:
        """A method's row."""
        if motion in self._broken:
            return Point(motion, method, failure=self._broken[motion])
        try:
            solver = self._solver(motion.tissue, method)
            return measure(solver, motion, answer, self._balance(method), progress)
        except Exception as error:
            self._solvers.pop(method, None)
            return Point(motion, method, failure=words_of(error))

    def _solver(self, tissue: str, method: str) -> TissueSolver:
        if tissue != self._tissue:
            self._tissue, self._solvers, self._patient = tissue, {}, None
        if method not in self._solvers:
            solver = create_solver(method, TISSUES[tissue].model)
            solver.warm_up()
            self._solvers[method] = solver
        return self._solvers[method]

    def _balance(self, method: str) -> TissueSolver | None:
        """What converges a method's frames; None where it solves other equations."""
        if method != METHOD:
            return None
        if self._patient is None:
            self._patient = patient_solver(TISSUES[self._tissue].model)
        return self._patient
