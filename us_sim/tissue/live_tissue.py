"""One tissue whose method, settings and materials change while frames go on.

Numba's compiler holds the interpreter's lock for most of its time. With Python's usual turns of
5 ms a frame in another thread waits a turn each time that it lets the lock go; with turns of 0.1 ms
it hardly does.
"""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numba.core import event
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.errors import SolverError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SOLVERS
from us_sim.tissue.elasticity.linear_tetrahedra import require_held
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import SolverSettings, TissueSolver, make_small_model

COMPILING_SWITCH_INTERVAL = 1e-4  # s, see above

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ShapeDifference:
    """Distances between the nodes of two deformations."""

    maximum: float  # m
    rms: float  # m


def measure_difference(first: NDArray[np.float64], second: NDArray[np.float64]) -> ShapeDifference:
    """Return the largest and the root-mean-square distance of two sets of positions (N, 3) m."""
    square = ((first - second) ** 2).sum(axis=1)
    return ShapeDifference(float(np.sqrt(square.max())), float(np.sqrt(square.mean())))


@dataclass(frozen=True)
class TissueMethod:
    """Solver of a tissue, the one beside it, and their settings and materials."""

    solver: str  # name of the method
    compared: str = ""  # name of a second method that runs beside it, '' for none
    settings: Mapping[str, SolverSettings] = field(default_factory=dict)  # of methods by name
    materials: Mapping[str, Material] = field(default_factory=dict)  # by label


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A method with its solvers made and compiled, or why they cannot be made."""

    method: TissueMethod
    model: TissueModel
    solvers: Mapping[str, TissueSolver]
    problem: str = ""


class LiveTissue:
    """Deforms a tissue by one solver, and by another on the same poses if asked.

    Each solver is made once for a model and its settings, when it is first named. `prepare_method`
    makes what another method needs in a thread while frames go on; `adopt_prepared` takes it over.

    Args:
        model: shared by all solvers.
        method: to begin with.
        constants: makes those of the mesh's tetrahedra from materials by label, where these change.
        progress: called with the fraction done, and what is being made or compiled.

    Raises:
        SolverError: no such solver, one compared with itself, or a model it cannot solve.

    Examples:
        >>> from us_sim.tissue.elasticity.material import Material
        >>> model = TissueModel.make_block(material=Material(10e3, 0.3, 1000.0))
        >>> tissue = LiveTissue(model, TissueMethod("fem_cg", compared="fem"))
        >>> for _ in range(20):
        ...     deformation = tissue.deform(Pose(position=[0.0, 0.0, 0.01]))
        >>> tissue.difference.maximum < 1e-5  # m: the same equations below Poisson's ratio 0.4
        True
    """

    def __init__(
        self,
        model: TissueModel,
        method: TissueMethod,
        constants: Callable[[Mapping[str, Material]], TissueMaterials] | None = None,
        progress: Progress | None = None,
    ) -> None:
        self.model = model
        self.method = method
        self.difference: ShapeDifference | None = None  # of the last frame, to the solver beside
        self._constants = constants
        self._solvers: dict[str, TissueSolver] = {}
        self._solvers |= self._make(method, progress).solvers
        self.solver = self._solvers[method.solver]
        self._beside = self._solvers.get(method.compared)
        self._wanted = method  # what is in use, or being prepared
        self._reason = ""  # what was changed, for a person
        self._prepared: _Prepared | None = None
        self._turn = threading.Lock()  # of the thread that prepares
        self._thread: threading.Thread | None = None
        self._began = 0.0  # s, of `time.monotonic`
        self._progress = ""

    @property
    def preparation_status(self) -> str:
        """Text on the method in preparation, its time so far, and its progress; "" without any."""
        if self._wanted is self.method:
            return ""
        seconds = time.monotonic() - self._began
        return f"preparing {self._reason} for {seconds:.0f} s{self._progress}"

    def deform(self, pose: Pose | None, frame_limit: float | None = None) -> Deformation:
        """Advance the solver in use by a frame, and the one beside it.

        Args:
            pose: of the probe in frame ``patient``, or None when none is near.
            frame_limit: s that it may take where the method can go on in the next.
        """
        self.solver.frame_limit = frame_limit
        deformation = self.solver.deform(pose)
        if self._beside is not None:
            self._beside.frame_limit = frame_limit
            self.difference = measure_difference(deformation.nodes, self._beside.deform(pose).nodes)
        return deformation

    def reset(self) -> None:
        """Bring the tissue to rest, as after a frame that failed halfway."""
        for solver in filter(None, (self.solver, self._beside)):
            solver.reset()
        self.difference = None

    def prepare_method(self, method: TissueMethod, reason: str, *, wait: bool = False) -> None:
        """Prepare another method in a thread; only the newest call counts.

        A call with the present method drops what was prepared.

        Args:
            method: the one to prepare.
            reason: the change that asks for it, for a person.
            wait: until it can be adopted.
        """
        self._prepared, self._progress, self._reason = None, "", reason
        self._began = time.monotonic()
        if method == self.method:
            self._wanted = self.method
            return
        self._wanted = method
        self._thread = threading.Thread(target=self._prepare, args=(method,), daemon=True)
        self._thread.start()
        if wait:
            self._thread.join()

    def adopt_prepared(self) -> bool:
        """Go on with what was prepared, from where the tissue is.

        Returns:
            Whether it was ready.

        Raises:
            SolverError: it cannot be made. The tissue goes on as it is.
        """
        prepared, self._prepared = self._prepared, None
        if prepared is None or prepared.method is not self._wanted:
            return False
        if prepared.problem:
            self._wanted = self.method
            raise SolverError(f"{self._reason}: {prepared.problem}")
        state = self.solver.state
        if prepared.model is not self.model:
            self.model, self._solvers = prepared.model, {}
        self._solvers |= prepared.solvers
        self.method = prepared.method
        before = self.solver, self._beside
        self.solver = prepared.solvers[self.method.solver]
        self._beside = prepared.solvers.get(self.method.compared)
        for now, then in zip((self.solver, self._beside), before, strict=True):
            if now is not None and now is not then:
                now.take_over(state)
        if self._beside is not before[1]:
            self.difference = None
        return True

    def _prepare(self, method: TissueMethod) -> None:
        with self._turn:
            if method is not self._wanted:
                return
            usual = sys.getswitchinterval()
            sys.setswitchinterval(COMPILING_SWITCH_INTERVAL)
            try:
                prepared = self._make(method, self._show)
            except UsSimError as error:
                prepared = _Prepared(method, self.model, {}, str(error))
            except Exception as error:  # so that the thread does not end silently
                _logger.exception("preparing %s", method.solver)
                prepared = _Prepared(method, self.model, {}, f"{type(error).__name__}: {error}")
            finally:
                sys.setswitchinterval(usual)
        if method is self._wanted:
            self._prepared = prepared

    def _make(self, method: TissueMethod, progress: Progress | None) -> _Prepared:
        if method.compared == method.solver:
            raise SolverError(f"{method.solver} is in use already: compare with another solver")
        model = self.model
        if self._constants is not None and method.materials != self.method.materials:
            model = replace(model, materials=self._constants(method.materials))
        solvers: dict[str, TissueSolver] = {}
        for name in filter(None, (method.solver, method.compared)):
            made, settings = self._solvers.get(name), method.settings.get(name)
            if made is None or made.model is not model or settings not in (None, made.settings):
                made = compile_solver(SOLVERS.load(name), model, settings, progress)
            solvers[name] = made
        return _Prepared(method, model, solvers)

    def _show(self, fraction: float, text: str) -> None:
        share = f"{100 * fraction:.0f} % of " if fraction > 0.0 else ""
        self._progress = f", {share}{text}"


def compile_solver(
    solver: type[TissueSolver],
    model: TissueModel,
    settings: SolverSettings | None = None,
    progress: Progress | None = None,
) -> TissueSolver:
    """Make a solver, none of whose frames will have to compile anything.

    Args:
        solver: the class of the method.
        model: of the tissue.
        settings: of the solver.
        progress: called with the fraction done and what is being made or compiled.

    Raises:
        SolverError: as `create_solver`.
    """
    if solver.must_be_held:  # before a minute of compiling
        require_held(model.mesh, model.fixed)
    settings = settings or solver.Settings()
    with _report_compiling(solver.name, progress):
        solver.compile_kernels(make_small_model(model), settings)
        return solver(model, settings, progress)


@contextlib.contextmanager
def _report_compiling(method: str, progress: Progress | None) -> Iterator[None]:
    """Tell ``progress`` of each kernel that this thread compiles within the context."""

    def say(number: int) -> None:
        if progress is not None:
            progress(0.0, f"compiling {method}, kernel {number}")

    with event.install_listener("numba:compile", _Listener(say)) as listener:
        yield
    if listener.count and progress is not None:
        progress(1.0, f"compiling {method}, {listener.count} kernels")


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
