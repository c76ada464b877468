"""Compliance of the surface that a probe can touch, and the field of each force on it."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim import Progress
from us_sim.cache import load_or_create
from us_sim.errors import SolverError
from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import (
    AveragedPressure,
    assemble_averaged_pressure,
    require_held,
)
from us_sim.tissue.linear_algebra.multifrontal import eliminate
from us_sim.tissue.model import TissueModel

_CHUNK = 64  # nodes for whose forces the fields are made at once
Solve = Callable[[NDArray[np.int64]], NDArray[np.floating]]


@dataclass(frozen=True, eq=False)
class DenseFields:
    """Displacements of F nodes by each of 3S unit forces."""

    nodes: NDArray[np.integer]  # (F,)
    fields: NDArray[np.floating]  # (3S, 3, F), m/N

    def __post_init__(self) -> None:
        # Always read-only, as from the cache: numba would compile the kernel again for others.
        for name in ("nodes", "fields"):
            array = getattr(self, name).view()
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @classmethod
    def compute_at(
        cls, nodes: NDArray[np.integer], forces: int, solve: Solve, precision: type
    ) -> DenseFields:
        """Compute the fields at ``nodes`` (F,) of forces on S nodes.

        Args:
            nodes: (F,), at which fields are kept.
            forces: S.
            solve: returns the (N, 3, 3K) m/N fields of unit forces on K of the S nodes.
            precision: of the numbers to keep.
        """
        fields: NDArray[np.floating] = np.empty((3 * forces, 3, len(nodes)), precision)
        for first in range(0, forces, _CHUNK):
            chunk = np.arange(first, min(first + _CHUNK, forces))
            fields[3 * first : 3 * chunk[-1] + 3] = solve(chunk)[nodes].transpose(2, 1, 0)
        return cls(nodes, fields)

    def add_displacement(
        self, forces: NDArray[np.float64], displacement: NDArray[np.floating]
    ) -> None:
        """Add the displacement by forces (3S,) N to displacement (N, 3) m; zeros are not read."""
        rows = np.flatnonzero(forces)
        _add_rows(self.fields, rows, forces[rows], self.nodes, displacement)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _add_rows(fields, rows, weights, nodes, displacement):
    width = 1024  # nodes of a piece that stays in the fastest cache
    four = len(rows) // 4 * 4
    whole = np.empty((fields.shape[1], width))
    for begin in range(0, len(nodes), width):
        end = min(begin + width, len(nodes))
        for axis in range(fields.shape[1]):
            piece = whole[axis, : end - begin]
            piece[:] = 0.0
            for m in range(0, four, 4):
                a = fields[rows[m], axis, begin:end]
                b = fields[rows[m + 1], axis, begin:end]
                c = fields[rows[m + 2], axis, begin:end]
                d = fields[rows[m + 3], axis, begin:end]
                p, q, r, s = weights[m], weights[m + 1], weights[m + 2], weights[m + 3]
                for i in range(len(piece)):
                    piece[i] += p * a[i] + q * b[i] + r * c[i] + s * d[i]
            for m in range(four, len(rows)):
                a = fields[rows[m], axis, begin:end]
                p = weights[m]
                for i in range(len(piece)):
                    piece[i] += p * a[i]
        for i in range(end - begin):
            for axis in range(fields.shape[1]):
                displacement[nodes[begin + i], axis] += whole[axis, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _quadratic(gram, rows, loads):
    total = 0.0
    for m in range(len(rows)):
        row = gram[rows[m]]
        part = 0.0
        for n in range(m):
            part += row[rows[n]] * loads[n]
        total += loads[m] * (2 * part + row[rows[m]] * loads[m])
    return total


_VERSION = 6  # Part of the cache's key: raise it when the bytes change
# Numbers in the fields below which they are in double precision, as single would save little
# time.
_DOUBLE = 4_000_000
# Numbers in the fields from which on they are cached, as making them takes a second, and up to
# which: nobody looks for more than a gigabyte in a cache.
_KEPT, _MOST_KEPT = 12_000_000, 250_000_000
# Numbers in the fields from which on all is in single precision, and the residual is sampled.
_LARGE = 100_000_000
# Number of single forces, and of presses, by which the error of large fields is measured.
_SAMPLES = 12
_PRESSED = 16  # nodes of the surface over those that such a press is on


@dataclass(frozen=True, eq=False)
class SurfaceCompliance:
    """Displacements per force at the S nodes that the probe can touch and move."""

    nodes: NDArray[np.int32]  # (S,), the model's movable contact nodes
    matrix: NDArray[np.float64]  # (3S, 3S), m/N, displacement 3 s + axis of force 3 t + axis
    fields: DenseFields  # of all nodes that are neither fixed nor of the surface
    count: int  # N, nodes of the mesh
    # (3S, 3S), products of the unbalanced forces that rounding leaves in the fields of two unit
    # forces; nothing where they are large
    gram: NDArray[np.float32]
    rounding: float  # unbalanced force in a large field, over the force; NaN: not measured

    def __post_init__(self) -> None:
        # Read-only as from the cache, for which numba compiles kernels of their own; and those that
        # a frame calls, which depend on the fields' kind and precision, are compiled now.
        self.matrix.flags.writeable = False
        self.gram.flags.writeable = False
        self.add_displacement(np.zeros((len(self.nodes), 3)), np.zeros((3, self.count), np.float32))
        self.compute_displacement(np.zeros((len(self.nodes), 3)))
        self.compute_imbalance(np.ones((len(self.nodes), 3)))

    def add_displacement(
        self, forces: NDArray[np.float64], displacement: NDArray[np.float32]
    ) -> None:
        """Add the displacement by forces (S, 3) N to displacement (3, N) m; zeros are not read."""
        self.fields.add_displacement(forces.ravel(), displacement.T)
        self._add_surface(forces, self._places[1], displacement)

    def compute_displacement(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 3) m, the displacement of every node by forces (S, 3) N."""
        displacement = np.zeros((self.count, 3))
        self.fields.add_displacement(forces.ravel(), displacement)
        self._add_surface(forces, self._places[0], displacement)
        return displacement

    @cached_property
    def _places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(3S,), where the surface is in fields (N, 3), and in fields (3, N)."""
        node, axis = self.nodes.astype(np.int64)[:, None], np.arange(3)
        return (3 * node + axis).ravel(), (node + self.count * axis).ravel()

    def _add_surface(
        self, forces: NDArray[np.float64], places: NDArray[np.int64], displacement: NDArray
    ) -> None:
        rows = np.flatnonzero(forces)
        columns = self.matrix[:, None, :]
        _add_rows(columns, rows, forces.ravel()[rows], places, displacement.reshape(-1, 1))

    def compute_imbalance(self, forces: NDArray[np.float64]) -> float:
        """Return the norm of the unbalanced force in the field of forces (S, 3) N, over theirs."""
        if len(self.gram) == 0:
            return self.rounding
        rows = np.flatnonzero(forces)
        loads = forces.ravel()[rows]
        return math.sqrt(max(_quadratic(self.gram, rows, loads), 0.0) / float(loads @ loads))


def compute_compliance(
    model: TissueModel,
    progress: Progress | None = None,
    *,
    needs_imbalance: bool = True,
) -> SurfaceCompliance:
    """Solve for a unit force along each axis at each node that the probe can touch.

    A result that takes long is kept in the user's cache folder, under a hash of mesh, materials,
    fixed and contact nodes.

    Args:
        model: of the tissue and the probe.
        progress: called with the fraction done and a label, if it takes a second or more.
        needs_imbalance: for `SurfaceCompliance.compute_imbalance`, a fifth of the work.

    Raises:
        SolverError: the tissue is not held, its moduli are too different, or the fields do not fit
            into memory.
    """
    require_held(model.mesh, model.fixed)
    touched, free = len(model.movable_contact_nodes), int((~model.fixed).sum())
    if 4 * 9 * touched * free > _memory() / 2:
        raise SolverError(
            f"{touched} nodes that the probe can touch, in a mesh of {free}, make fields of "
            f"{36e-9 * touched * free:.0f} GB, more than half of this machine's memory: give a "
            f"coarser mesh, or choose fem_cg or msds"
        )
    if not _KEPT <= 9 * touched * free <= _MOST_KEPT:
        return _compute(model, progress, needs_imbalance)
    return load_or_create(_key(model), _pack, _unpack, lambda: _compute(model, progress))


def compute_loaded_displacement(model: TissueModel) -> NDArray[np.float64]:
    """Return (N, 3) m, the displacement of linear tissue by the model's own load, without a probe.

    Raises:
        SolverError: the tissue is not held, or its moduli are too different.
    """
    require_held(model.mesh, model.fixed)
    if not model.load.any():
        return np.zeros_like(model.mesh.nodes)
    system = assemble_averaged_pressure(model.mesh, model.materials)
    with threadpool_limits(1, user_api="blas"):
        eliminated = eliminate(model.mesh, system, model.fixed, np.flatnonzero(~model.fixed))
        return eliminated.compute_displacement(model.load).astype(np.float64)


def _compute(
    model: TissueModel,
    progress: Progress | None,
    needs_imbalance: bool = True,
) -> SurfaceCompliance:
    def show(fraction: float) -> None:
        if progress is not None:
            progress(fraction, "compliance of the surface")

    nodes, points = model.movable_contact_nodes, model.mesh.nodes
    free = np.flatnonzero(~model.fixed)
    size = 9 * len(nodes) * len(free)
    is_large = size >= _LARGE
    system = assemble_averaged_pressure(model.mesh, model.materials)
    matrix = np.empty((3 * len(nodes), 3 * len(nodes)))
    done = 0
    # Products of matrices this small take longer on several threads.
    with threadpool_limits(1, user_api="blas"):
        eliminated = eliminate(
            model.mesh,
            system,
            model.fixed,
            nodes,
            np.float32 if is_large else np.float64,
            lambda fraction: show(0.6 * fraction),
        )

        def solve(chosen: NDArray[np.int64]) -> NDArray[np.floating]:
            nonlocal done
            moved = eliminated.compute_fields(nodes[chosen])
            columns = (3 * chosen[:, None] + np.arange(3)).ravel()
            matrix[:, columns] = moved[nodes].reshape(len(matrix), -1)
            done += len(chosen)
            show(0.6 + 0.4 * done / len(nodes))
            return moved

        precision = np.float64 if size < _DOUBLE else np.float32
        inner = np.setdiff1d(free, nodes)
        found = DenseFields.compute_at(inner, len(nodes), solve, precision)
        matrix += matrix.T  # symmetric to the last digit
        matrix /= 2
        none = np.zeros((0, 0), np.float32)
        made = SurfaceCompliance(nodes, matrix, found, len(points), none, math.nan)
        if not needs_imbalance:
            return made
        if not is_large:
            return replace(made, gram=_gram(made, found, system, model.fixed))
    return replace(made, rounding=_rounding(made, points[nodes], system, model.fixed))


def _memory() -> float:
    """Return the bytes of this machine's memory; infinite where the system does not say."""
    if not hasattr(os, "sysconf"):
        return math.inf
    return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")


def _gram(
    made: SurfaceCompliance, found: DenseFields, system: AveragedPressure, fixed: NDArray
) -> NDArray[np.float32]:
    """Return (3S, 3S), products of the unbalanced forces in the fields of two unit forces."""
    size, free = len(made.matrix), np.flatnonzero(~fixed)
    system, place = system.restrict_to(free), np.cumsum(~fixed) - 1
    loaded = (3 * place[made.nodes][:, None] + np.arange(3)).ravel()
    left = np.empty((size, 3 * len(free)), np.float32)
    for first in range(0, size, 3 * _CHUNK):
        part = np.arange(first, min(first + 3 * _CHUNK, size))
        moved = np.empty((len(free), 3, len(part)))
        moved[place[found.nodes]] = found.fields[part].transpose(2, 1, 0)
        moved[place[made.nodes]] = made.matrix[:, part].reshape(-1, 3, len(part))
        balance = system.compute_forces(moved).reshape(-1, len(part))
        balance[loaded[part], np.arange(len(part))] -= 1.0
        left[part] = balance.T
    return left @ left.T


def _rounding(
    made: SurfaceCompliance, points: NDArray, system: AveragedPressure, fixed: NDArray
) -> float:
    """Measure the unbalanced force over the norm of the forces.

    It is the median of single forces or of presses, whichever is larger.
    """
    random = np.random.Generator(np.random.PCG64(0))
    medians = []
    for count in (1, 1 + len(points) // _PRESSED):
        found = []
        for _ in range(min(_SAMPLES, 3 * len(points))):
            distance = np.linalg.norm(points - points[random.integers(len(points))], axis=1)
            load = np.zeros_like(points)
            load[np.argsort(distance)[:count]] = random.normal(size=3)
            balance = system.compute_forces(made.compute_displacement(load))
            balance[made.nodes] -= load
            balance[fixed] = 0.0
            found.append(float(np.linalg.norm(balance) / np.linalg.norm(load)))
        medians.append(float(np.median(found)) if found else 0.0)
    return max(medians)


def _key(model: TissueModel) -> str:
    digest = hashlib.sha256(str(_VERSION).encode())
    materials = model.materials
    for array in (
        model.mesh.nodes,
        model.mesh.tetrahedra,
        materials.young_modulus,
        materials.poisson_ratio,
        model.fixed,
        model.movable_contact_nodes,
    ):
        digest.update(f"{array.dtype} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return f"compliance-{digest.hexdigest()[:24]}"


def _pack(made: SurfaceCompliance) -> tuple[dict[str, NDArray], dict[str, Any]]:
    own = {"surface": made.nodes, "matrix": made.matrix, "gram": made.gram}
    return {**own, **vars(made.fields)}, {"count": made.count, "rounding": made.rounding}


def _unpack(arrays: dict[str, NDArray], facts: dict[str, Any]) -> SurfaceCompliance:
    return SurfaceCompliance(
        arrays["surface"],
        arrays["matrix"],
        DenseFields(arrays["nodes"], arrays["fields"]),
        count=int(facts["count"]),
        gram=arrays["gram"],
        rounding=float(facts["rounding"]),
    )
