"""Compiling a solver's kernels, where frames must go on meanwhile in a process of its own.

Numba's compiler holds the interpreter's lock for most of its time, so that a frame in another
thread takes many times as long. Another process has a lock of its own: it compiles the kernels into
numba's cache on disk, from where this one loads them. Where that cache cannot be written, or the
process fails, they are compiled here.

>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.compilation import compile_kernels
>>> from us_sim.tissue.solvers.fem_cg import FemCg, FemCgSettings
>>> compile_kernels(FemCg, TissueModel.block(), FemCgSettings())
>>> compile_kernels(FemCg, TissueModel.block(), FemCgSettings(), print)  # nothing is left to do
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

from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.rehearsal import rehearsal_model
from us_sim.tissue.solvers.solver import SolverSettings, TissueSolver

__all__ = ["compile_kernels", "compiling_said"]

Progress = Callable[[float, str], None]

_NICENESS = 5
"""By how much the process that compiles gives way to the one that deforms."""

_logger = logging.getLogger(__name__)


def compile_kernels(
    solver: type[TissueSolver],
    model: TissueModel,
    settings: SolverSettings,
    progress: Progress | None = None,
    *,
    elsewhere: bool = False,
) -> None:
    """Compile what a solver needs for a model, or load it from numba's cache.

    Args:
        solver: the class of the method.
        model: of the tissue that is to be deformed; another as small as can be stands in for it.
        settings: of the solver.
        progress: told what is being compiled.
        elsewhere: compile in another process, so that other threads of this one are not held up.
    """
    small = rehearsal_model(model)
    if elsewhere and not _is_compiled(solver, small, settings):
        _compile_elsewhere(solver, small, settings, progress)
    with compiling_said(solver.name, progress):
        solver.rehearse(small, settings)


@contextlib.contextmanager
def compiling_said(method: str, progress: Progress | None) -> Iterator[None]:
    """Tell ``progress`` of each kernel that this thread compiles within the context."""

    def say(number: int) -> None:
        if progress is not None:
            progress(0.0, _sentence(method, number))

    with event.install_listener("numba:compile", _Listener(say)) as listener:
        yield
    if listener.count and progress is not None:
        progress(1.0, _sentence(method, listener.count))


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


def _sentence(method: str, number: int) -> str:
    return f"compiling {method}, kernel {number}"


def _is_compiled(solver: type[TissueSolver], small: TissueModel, settings: SolverSettings) -> bool:
    """Whether all kernels are in memory or in the cache; it ends at the first that is not."""

    def refuse(_: int) -> None:
        raise _ColdError

    try:
        with event.install_listener("numba:compile", _Listener(refuse)):
            solver.rehearse(small, settings)
    except _ColdError:
        return False
    return True


def _compile_elsewhere(
    solver: type[TissueSolver],
    small: TissueModel,
    settings: SolverSettings,
    progress: Progress | None,
) -> None:
    """Let another process fill the cache; where it fails, why goes into the log only."""
    try:
        task = pickle.dumps((solver, small, settings))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        _logger.info("%s is compiled in this process: %s", solver.name, error)
        return
    process = subprocess.Popen(
        [sys.executable, "-m", __name__],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        start_new_session=True,  # an interrupt from the terminal is for this process
    )
    assert process.stdin is not None
    assert process.stdout is not None
    said = ""
    with process, contextlib.suppress(BrokenPipeError):
        process.stdin.write(task)
        process.stdin.close()
        for line in process.stdout:
            said = line.decode(errors="replace").strip() or said
            if progress is not None and said.isdecimal():
                progress(0.0, _sentence(solver.name, int(said)))
    if process.returncode:
        _logger.warning("%s is compiled in this process: %s", solver.name, said)


def _main() -> None:
    """Compile what comes in at stdin; a line on stdout for each kernel."""
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    solver, small, settings = pickle.load(sys.stdin.buffer)
    # When nobody reads any more, the pipe breaks, and this ends.
    with event.install_listener("numba:compile", _Listener(lambda n: print(n, flush=True))):
        solver.rehearse(small, settings)


if __name__ == "__main__":
    _main()
