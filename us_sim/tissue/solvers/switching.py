"""One tissue and the solver that deforms it: changed, compiled and compared while frames go on.

Numba's compiler holds the interpreter's lock for most of its time, so that a frame in another
thread takes many times as long. Another process has a lock of its own: it makes the same solver
once, which leaves the kernels in numba's cache on disk, from where this one loads them. Where that
cache cannot be written, or the process fails, they are compiled here.

>>> from us_sim.tissue.elasticity.material import Material
>>> tissue = SwitchableTissue(TissueModel.block(material=Material(10e3, 0.3, 1000.0)), "fem_cg")
>>> tissue.compare_with("fem")
>>> for _ in range(20):
...     deformation = tissue.deform(Pose(position=[0.0, 0.0, 0.01]))
>>> tissue.difference.maximum < 1e-5  # m: the same equations below Poisson's ratio 0.4
True
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numba.core import event
from numpy.typing import NDArray

from us_sim.errors import SolverError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SOLVERS
from us_sim.tissue.elasticity.linear_tetrahedra import require_held
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import Progress, SolverSettings, TissueSolver, rehearsal_model

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Difference:
    """How far the nodes of two deformations are apart."""

    maximum: float  # m
    rms: float  # m


def difference(first: NDArray[np.float64], second: NDArray[np.float64]) -> Difference:
    """Largest and root-mean-square distance between two sets of node positions (N, 3) m."""
    square = ((first - second) ** 2).sum(axis=1)
    return Difference(float(np.sqrt(square.max())), float(np.sqrt(square.mean())))


@dataclass(frozen=True)
class Plan:
    """The solvers and settings with which a tissue is to be deformed."""

    solver: str  # name of the method
    compared: str = ""  # name of a second method that runs beside it, '' for none
    settings: Mapping[str, SolverSettings] = field(default_factory=dict)  # of methods by name
    model: Callable[[], TissueModel] | None = None  # makes a new one; None keeps the present one
    reason: str = ""  # what was changed, for a person


@dataclass(frozen=True, eq=False)
class Prepared:
    """A plan with its solvers made and compiled."""

    plan: Plan
    model: TissueModel
    solvers: dict[str, TissueSolver]


@dataclass(frozen=True)
class Failed:
    """A plan that cannot be carried out, and why."""

    plan: Plan
    problem: str


class SwitchableTissue:
    """Deforms a tissue with one solver by name, and with another on the same poses if asked.

    Each solver is made once for a model and its settings, when it is first named.

    Args:
        model: shared by all solvers.
        name: of the solver in use.
        settings: of solvers by their names; those missing have their defaults.

    Raises:
        SolverError: as `create_solver`.
    """

    def __init__(
        self,
        model: TissueModel,
        name: str,
        settings: Mapping[str, SolverSettings] | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._model = model
        self._solvers: dict[str, TissueSolver] = {}
        self._plan = Plan(name, settings=dict(settings or {}))
        self._solvers = self.make(self._plan, progress).solvers
        self._solver = self._solvers[name]
        self._beside: TissueSolver | None = None
        self._frame_limit: float | None = None
        self.difference: Difference | None = None

    @property
    def model(self) -> TissueModel:
        """The tissue as it is now."""
        return self._model

    @property
    def name(self) -> str:
        """Name of the solver in use."""
        return self._solver.name

    @property
    def compared(self) -> str:
        """Name of the solver beside it, '' when there is none."""
        return self._beside.name if self._beside else ""

    @property
    def is_settled(self) -> bool:
        """Whether another frame at the same pose would change nothing."""
        return self._solver.is_settled

    def limit_frames(self, duration: float | None) -> None:
        """Let no frame take longer than this (s) where the method can go on in the next."""
        self._frame_limit = duration
        for solver in filter(None, (self._solver, self._beside)):
            solver.frame_limit = duration

    def contact_stiffness(self) -> NDArray[np.float64] | None:
        """`TissueSolver.contact_stiffness` of the solver in use."""
        return self._solver.contact_stiffness()

    def discretisation_error(self) -> float | None:
        """`TissueSolver.discretisation_error` of the solver in use."""
        return self._solver.discretisation_error()

    def make(
        self,
        plan: Plan,
        progress: Progress | None = None,
        *,
        beside: bool = False,
    ) -> Prepared:
        """Make and compile the solvers of a plan that are not there yet; nothing else changes.

        Args:
            plan: what is wanted.
            progress: as for `create_solver`, and told what is being compiled.
            beside: it is called in a thread of its own while another deforms the tissue, which is
                not to be held up.

        Raises:
            SolverError: no such solver, one compared with itself, or a model it cannot solve.
        """
        if plan.compared == plan.solver:
            raise SolverError(f"{plan.solver} is in use already: compare with another solver")
        model = plan.model() if plan.model else self._model
        solvers: dict[str, TissueSolver] = {}
        for name in filter(None, (plan.solver, plan.compared)):
            made = self._solvers.get(name)
            settings = plan.settings.get(name)
            if made is None or made.model is not model or settings not in (None, made.settings):
                made = self._made(name, model, settings, progress, beside)
            solvers[name] = made
        return Prepared(plan, model, solvers)

    def _made(
        self,
        name: str,
        model: TissueModel,
        settings: SolverSettings | None,
        progress: Progress | None,
        beside: bool,
    ) -> TissueSolver:
        cls: type[TissueSolver] = SOLVERS.load(name)
        if cls.must_be_held:  # before a minute of compiling
            require_held(model.mesh, model.fixed)
        return compiled_solver(cls, model, settings or cls.Settings(), progress, elsewhere=beside)

    def adopt(self, prepared: Prepared) -> None:
        """Go on with the solvers made, from where the tissue is."""
        plan, state = prepared.plan, self._solver.state
        if prepared.model is not self._model:
            self._model, self._solvers = prepared.model, {}
        self._solvers |= prepared.solvers
        self._plan = replace(plan, model=None)
        solver = prepared.solvers[plan.solver]
        if solver is not self._solver:
            solver.take_over(state)
            solver.frame_limit = self._frame_limit
            self._solver = solver
        beside = prepared.solvers.get(plan.compared)
        if beside is not self._beside:
            self.difference = None
            if beside is not None:
                beside.take_over(state)
                beside.frame_limit = self._frame_limit
        self._beside = beside

    def use(self, name: str) -> None:
        """Switch to another solver; it goes on from where the tissue is.

        Raises:
            SolverError: no such solver, or it cannot solve this model.
        """
        compared = "" if name == self.compared else self.compared
        self.adopt(self.make(replace(self._plan, solver=name, compared=compared)))

    def compare_with(self, name: str, progress: Progress | None = None) -> None:
        """Run a second solver on the same poses from here on; '' ends it.

        Args:
            name: of the solver.
            progress: as for `make`.

        Raises:
            SolverError: it is the one in use.
        """
        self.adopt(self.make(replace(self._plan, compared=name), progress))

    def reset(self) -> None:
        """Bring the tissue to rest, as after a frame that failed halfway."""
        for solver in filter(None, (self._solver, self._beside)):
            solver.reset()
        self.difference = None

    def deform(self, pose: Pose | None) -> Deformation:
        """One frame of the solver in use, and of the one beside it."""
        deformation = self._solver.deform(pose)
        if self._beside is not None:
            other = self._beside.deform(pose)
            self.difference = difference(deformation.nodes, other.nodes)
        return deformation


class Preparation:
    """Prepares a plan's parts in a thread; the newest plan wins.

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
        """The plan that is being made, for how long already, and how far it is; '' without any."""
        with self._lock:
            if self._thread is None or self._newest is None:
                return ""
            seconds = time.monotonic() - self._began
            return f"preparing {self._newest.reason} for {seconds:.0f} s{self._progress}"

    def want(self, plan: Plan) -> None:
        """Begin to prepare a plan; the preparation of another one is dropped."""
        with self._lock:
            self._wanted = self._newest = plan
            self._outcome = None
            if self._thread is None:
                self._began = time.monotonic()
                self._thread = threading.Thread(target=self._work, name="solver", daemon=True)
                self._thread.start()

    def drop(self) -> None:
        """Drop all plans; a thread ends with the part that it is making."""
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


def compiled_solver(
    solver: type[TissueSolver],
    model: TissueModel,
    settings: SolverSettings,
    progress: Progress | None = None,
    *,
    elsewhere: bool = False,
) -> TissueSolver:
    """A solver, none of whose frames will have to compile anything.

    Args:
        solver: the class of the method.
        model: of the tissue.
        settings: of the solver.
        progress: told the fraction done and what is being made or compiled.
        elsewhere: what is not compiled yet is compiled in another process, so that other threads
            of this one are not held up.

    Raises:
        SolverError: as `create_solver`.
    """
    if elsewhere:
        # The partial solver is released before the other process makes one.
        with (
            contextlib.suppress(_ColdError),
            event.install_listener("numba:compile", _Listener(_refuse)),
        ):
            return _made(solver, model, settings, progress)
        _make_elsewhere(solver, model, settings, progress)
    with _compiling_said(solver.name, progress):
        return _made(solver, model, settings, progress)


def _made(
    solver: type[TissueSolver],
    model: TissueModel,
    settings: SolverSettings,
    progress: Progress | None,
) -> TissueSolver:
    solver.rehearse(rehearsal_model(model), settings)
    return solver(model, settings, progress)


@contextlib.contextmanager
def _compiling_said(method: str, progress: Progress | None) -> Iterator[None]:
    """Tell ``progress`` of each kernel that this thread compiles within the context."""

    def say(number: int) -> None:
        if progress is not None:
            progress(0.0, f"compiling {method}, kernel {number}")

    with event.install_listener("numba:compile", _Listener(say)) as listener:
        yield
    if listener.count and progress is not None:
        progress(1.0, f"compiling {method}, {listener.count} kernels")


class _ColdError(Exception):
    """A kernel is not compiled."""


class _Listener(event.Listener):
    """Counts the kernels that the thread in which it was made begins to compile."""

    def __init__(self, tell: Callable[[int], None]) -> None:
        self._tell = tell
        self._thread = threading.get_ident()
        self.count = 0

    def on_start(self, _: event.Event) -> None:
        if threading.get_ident() == self._thread:
            self.count += 1
            self._tell(self.count)

    def on_end(self, _: event.Event) -> None:
        pass


def _refuse(_: int) -> None:
    raise _ColdError


def _make_elsewhere(
    solver: type[TissueSolver],
    model: TissueModel,
    settings: SolverSettings,
    progress: Progress | None,
) -> None:
    """Let another process fill the cache; where it fails, why goes into the log only."""
    try:
        task = pickle.dumps((solver, model, settings))
        process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # an interrupt from the terminal is for this process
        )
    except (pickle.PicklingError, AttributeError, TypeError, OSError) as error:
        _logger.info("%s is compiled in this process: %s", solver.name, error)
        return
    assert process.stdin is not None
    assert process.stdout is not None
    said = ""
    with process:
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(task)
            process.stdin.flush()  # it stays open: where this process ends, so does the other
        for line in process.stdout:
            said = line.decode(errors="replace").strip() or said
            fraction, _, text = said.partition("\t")
            with contextlib.suppress(ValueError):  # a warning, say
                if progress is not None:
                    progress(float(fraction), text)
    if process.returncode:
        _logger.warning("%s is compiled in this process: %s", solver.name, said)


def _main() -> None:
    """Make the solver read from stdin; print a line for each step of progress."""
    if hasattr(os, "nice"):
        os.nice(5)  # it gives way to the process that deforms
    solver, model, settings = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_asker, daemon=True).start()

    def show(fraction: float, text: str) -> None:
        print(f"{fraction:.3f}\t{text}", flush=True)

    with contextlib.suppress(UsSimError):  # which the process that asked will find as well
        compiled_solver(solver, model, settings, show)


def _end_with_asker() -> None:
    """End this process, whatever it compiles, when nobody waits for it any more."""
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    _main()
