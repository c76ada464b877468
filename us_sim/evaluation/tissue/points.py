"""One point of error against run time: a method, its settings, a mesh, and what it got wrong.

>>> import numpy as np
>>> from us_sim.evaluation.tissue.points import Outcome, compare
>>> nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
>>> exact = Outcome(nodes * 0.1, 10.0, 1.0)
>>> errors = compare(Outcome(nodes * 0.11, 9.0, 1.01), exact, rest_volume=2.0)
>>> [round(error, 4) for error in errors]
[0.1, 10.0, 0.1, 0.005]
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.evaluation.row import Row, not_a_column
from us_sim.evaluation.run_times import RunTimes
from us_sim.evaluation.tissue.cases import Scene
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import TissueSolver

_PASSES = 3  # along the path; the first is not timed
_LONGEST = 20.0  # s, after which no further pass begins


class Errors(NamedTuple):
    """How much one outcome differs from another."""

    rel_l2_error: float  # of the nodes' displacements
    max_error_mm: float  # of the worst node
    force_error: float  # of the force along the probe's axis, relative
    volume_error: float  # of the block's volume, over its volume at rest


@dataclass(frozen=True)
class Point(Row):
    """A row of tissue.csv, and what the report says beyond it."""

    scene: str
    method: str
    nodes: int
    tets: int
    threads: int
    setting: str
    ms_median: float = float("nan")
    ms_p99: float = float("nan")
    rel_l2_error: float = float("nan")
    max_error_mm: float = float("nan")
    force_error: float = float("nan")
    volume_error: float = float("nan")
    reference: str = ""  # what the errors are against; begins with `own` or with `nonlinear`
    default: bool = not_a_column(False)
    memory: float = not_a_column(float("nan"))  # bytes
    setup: float = not_a_column(float("nan"))  # s
    smallest_volume_ratio: float = not_a_column(float("nan"))
    failure: str = not_a_column("")

    @property
    def title(self) -> str:
        """The method, its settings, and what it was tried on."""
        return f"{self.method} ({self.setting}), {self.scene}, {self.nodes:,} nodes"

    @property
    def own(self) -> bool:
        """Whether the errors are against the method's own converged equations."""
        return self.reference.startswith("own")


@dataclass(frozen=True, eq=False)
class Outcome:
    """What is compared: of a method, or of a reference at the same nodes."""

    displacement: NDArray[np.float64]  # (N, 3) m
    force: float  # N, on the probe along its axis
    volume: float  # m3, of the deformed block

    @classmethod
    def of(cls, model: TissueModel, deformation: Deformation) -> Outcome:
        """A solver's."""
        return cls(
            deformation.nodes - model.mesh.nodes,
            float(deformation.force[2]),
            float(signed_volumes(deformation.nodes, model.mesh.tetrahedra).sum()),
        )


@dataclass(frozen=True, eq=False)
class Timing(RunTimes):
    """A scene's path, followed frame by frame; a run is a timed frame."""

    last: Deformation


def timed(solver: TissueSolver, scene: Scene, threads: int) -> Timing:
    """Follow the path a few times from rest; the first pass warms caches and does not count."""
    frames: list[float] = []
    begin = time.perf_counter()
    with threadpool_limits(threads):
        for number in range(_PASSES):
            solver.reset()
            frames = [] if number <= 1 else frames
            for pose in scene.path:
                before = time.perf_counter()
                last = solver.deform(pose)
                frames.append((time.perf_counter() - before) * 1e3)
            if time.perf_counter() - begin > _LONGEST:
                break
    return Timing(np.array(frames), last)


def compare(found: Outcome, exact: Outcome, rest_volume: float) -> Errors:
    """How wrong ``found`` is."""
    difference = found.displacement - exact.displacement
    return Errors(
        float(np.linalg.norm(difference) / np.linalg.norm(exact.displacement)),
        float(np.linalg.norm(difference, axis=1).max() * 1e3),
        abs(found.force / exact.force - 1.0),
        abs(found.volume - exact.volume) / rest_volume,
    )


def held_memory(solver: TissueSolver) -> int:
    """Bytes of all arrays that a solver holds, each once, those of its mesh included."""
    seen: set[int] = set()
    arrays: dict[int, int] = {}
    left: list[Any] = [solver]
    while left:
        thing = left.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, np.ndarray):
            while isinstance(thing.base, np.ndarray):
                thing = thing.base
            arrays[id(thing)] = thing.nbytes
        elif isinstance(thing, dict):
            left.extend(thing.values())
        elif isinstance(thing, list | tuple | set | frozenset):
            left.extend(thing)
        elif not isinstance(thing, type) and hasattr(thing, "__dict__") and not callable(thing):
            left.extend(vars(thing).values())
    return sum(arrays.values())
