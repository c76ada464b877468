"""Making a solver with its kernels compiled, where frames must go on in another process.

Numba's compiler holds the interpreter's lock for most of its time, so that a frame in another
thread takes many times as long. Another process has a lock of its own: it makes the same solver
once, which leaves the kernels in numba's cache on disk, from where this one loads them. Where that
cache cannot be written, or the process fails, they are compiled here.

>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.compilation import compiled_solver
>>> from us_sim.tissue.solvers.fem_cg import FemCg, FemCgSettings
>>> compiled_solver(FemCg, TissueModel.block(), FemCgSettings()).name
'fem_cg'
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

from numba.core import event

from us_sim.errors import UsSimError
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.rehearsal import rehearsal_model
from us_sim.tissue.solvers.solver import SolverSettings, TissueSolver

Progress = Callable[[float, str], None]

_NICENESS = 5
"""By how much the process that compiles gives way to the one that deforms."""

_logger = logging.getLogger(__name__)


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
        # What was made until then is let go before the other process makes it.
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
        with contextlib.suppress(BrokenPipeError), process.stdin:
            process.stdin.write(task)
        for line in process.stdout:
            said = line.decode(errors="replace").strip() or said
            fraction, _, text = said.partition("\t")
            with contextlib.suppress(ValueError):  # a warning, say
                if progress is not None:
                    progress(float(fraction), text)
    if process.returncode:
        _logger.warning("%s is compiled in this process: %s", solver.name, said)


def _main() -> None:
    """Make what comes in at stdin; a line on stdout for each word of progress."""
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    solver, model, settings = pickle.load(sys.stdin.buffer)

    def show(fraction: float, text: str) -> None:
        # When nobody reads any more, the pipe breaks, and this process ends.
        print(f"{fraction:.3f}\t{text}", flush=True)

    with contextlib.suppress(UsSimError):  # which the process that asked will find as well
        compiled_solver(solver, model, settings, show)


if __name__ == "__main__":
    _main()
