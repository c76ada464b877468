"""The compliance of the surface that a probe can touch, and the field of each force in the tissue.

>>> import numpy as np
>>> from us_sim.tissue.linear_algebra.compliance import surface_compliance
>>> from us_sim.tissue.model import TissueModel
>>> model = TissueModel.block(nodes=(5, 5, 5))
>>> compliance = surface_compliance(model)
>>> forces = np.zeros((25, 3))
>>> forces[12, 2] = 1.0  # N, downwards in the middle of the top
>>> field = compliance.field(forces)
>>> middle = compliance.nodes[12]
>>> bool(field[middle, 2] > 0), bool(np.isclose(field[middle, 2], compliance.matrix[38, 38]))
(True, True)
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.cache import Form, kept
from us_sim.tissue.elasticity.averaged_pressure import AveragedPressure, averaged_pressure
from us_sim.tissue.elasticity.linear_tetrahedra import require_held
from us_sim.tissue.linear_algebra.condensation import Field, condense
from us_sim.tissue.model import TissueModel

__all__ = ["SurfaceCompliance", "surface_compliance"]

_VERSION = 3
"""Part of the cache's key: raise it when the bytes change."""

_DOUBLE = 4_000_000
"""Numbers in the fields below which they are in double precision, as single would save little
time."""

_KEPT = 12_000_000
"""Numbers in the fields from which on they are cached, as making them takes a second."""

_INTEGER = 400_000_000
"""Numbers in the fields from which on they are 16-bit integers with a scale for each block of
nodes, as reading them, and not the arithmetic, then takes the time."""

_BLOCK = 1024  # nodes

_SAMPLES = 24
"""Number of forces by which the rounding error of the fields is measured."""


@dataclass(frozen=True, eq=False)
class SurfaceCompliance:
    """Displacements per force at the S nodes that the probe can touch and move."""

    nodes: NDArray[np.int32]  # (S,), the model's movable contact nodes
    free: NDArray[np.int32]  # (F,), nodes that are not fixed, neighbours together
    matrix: NDArray[np.float64]  # (3S, 3S), m/N, displacement 3 s + axis of force 3 t + axis
    fields: NDArray  # (3S, 3, F), m/N, what each force does to all free nodes; integers if scaled
    scales: NDArray[np.float32]  # (3S, 3, blocks of F), m/N, of integers; else (0, 3, 0)
    count: int  # N, nodes of the mesh
    rounding: float  # unbalanced force in a field due to rounding, over the force

    def add_field(self, forces: NDArray[np.float64], displacement: NDArray[np.float32]) -> None:
        """Add what forces (S, 3) N do to displacement (3, N) m; rows without force are not read."""
        self._add(forces, displacement.T)

    def field(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) m, what forces (S, 3) N do to every node."""
        displacement = np.zeros((self.count, 3))
        self._add(forces, displacement)
        return displacement

    def _add(self, forces: NDArray[np.float64], displacement: NDArray[np.floating]) -> None:
        rows = np.flatnonzero(forces)
        weights = forces.ravel()[rows]
        if len(self.scales):
            _add_scaled_rows(self.fields, self.scales, rows, weights, self.free, displacement)
        else:
            _add_rows(self.fields, rows, weights, self.free, displacement)


def surface_compliance(
    model: TissueModel, progress: Callable[[float, str], None] | None = None
) -> SurfaceCompliance:
    """Solve for a unit force along each axis at each node that the probe can touch.

    A result that takes long is kept in the user's cache folder, under a hash of mesh, materials,
    fixed and contact nodes.

    Args:
        model: the tissue.
        progress: told the fraction done and what is being done, if it takes a second or more.

    Raises:
        SolverError: the tissue is not held, or its moduli are too different.
    """
    require_held(model.mesh, model.fixed)
    touched, free = len(model.movable_contact_nodes), int((~model.fixed).sum())
    if 9 * touched * free < _KEPT:
        return _made(model, None)

    def waiting() -> None:
        if progress is not None:
            progress(0.0, "waiting for another process that computes it")

    return kept(_key(model), _FORM, lambda: _made(model, progress), waiting)


def _made(model: TissueModel, progress: Callable[[float, str], None] | None) -> SurfaceCompliance:
    def show(fraction: float) -> None:
        if progress is not None:
            progress(fraction, "compliance of the surface")

    nodes = model.movable_contact_nodes
    count = int((~model.fixed).sum())
    system = averaged_pressure(model.mesh, model.materials)
    size = 9 * len(nodes) * count
    # Products of matrices this small take longer on several threads.
    with threadpool_limits(1, user_api="blas"):
        condensed = condense(
            model.mesh,
            system,
            model.fixed,
            nodes,
            np.float64 if size < _INTEGER else np.float32,
            report=lambda done: show(0.6 * done),
        )
        precision = np.float64 if size < _DOUBLE else np.float32
        fields = np.empty((3 * len(nodes), 3, count), precision if size < _INTEGER else np.int16)
        scaled = (len(fields), 3, -(-count // _BLOCK)) if size >= _INTEGER else (0, 3, 0)
        scales = np.zeros(scaled, np.float32)
        done = 0
        order = []
        for block, moved in _blocks(condensed.fields()):
            place = slice(done, done + len(block))
            if len(scales):
                scale = np.maximum(np.abs(moved).max(axis=2), np.finfo(np.float32).tiny) / 32767
                scales[:, :, done // _BLOCK] = scale
                moved = np.rint(moved / scale[:, :, None])
            fields[:, :, place] = moved
            done += len(block)
            order.append(block)
            show(0.6 + 0.4 * done / count)
    free = np.concatenate(order).astype(np.int32) if order else np.empty(0, np.int32)
    made = SurfaceCompliance(
        nodes, free, condensed.compliance, fields, scales, len(model.mesh.nodes), 0.0
    )
    return replace(made, rounding=_rounding(made, system, model.fixed))


def _blocks(parts: Iterator[Field]) -> Iterator[Field]:
    """The fields of parts, in blocks of a fixed number of nodes B: (B,), (3S, 3, B) m/N."""
    waiting: list[Field] = []
    for part, rows in parts:
        if len(part) == 0:
            continue
        waiting.append((part, rows.reshape(len(part), 3, -1).transpose(2, 1, 0)))
        if sum(len(nodes) for nodes, _ in waiting) >= _BLOCK:
            nodes = np.concatenate([nodes for nodes, _ in waiting])
            moved = np.concatenate([moved for _, moved in waiting], axis=2)
            whole = len(nodes) // _BLOCK * _BLOCK
            for first in range(0, whole, _BLOCK):
                yield nodes[first : first + _BLOCK], moved[:, :, first : first + _BLOCK]
            waiting = [(nodes[whole:], moved[:, :, whole:])] if len(nodes) > whole else []
    if waiting:
        nodes = np.concatenate([nodes for nodes, _ in waiting])
        yield nodes, np.concatenate([moved for _, moved in waiting], axis=2)


def _rounding(made: SurfaceCompliance, system: AveragedPressure, fixed: NDArray[np.bool_]) -> float:
    """The unbalanced force of single forces, in the median, or of all together, over their norm."""
    random = np.random.Generator(np.random.PCG64(0))
    loads = [np.zeros((len(made.nodes), 3)) for _ in range(min(_SAMPLES, 3 * len(made.nodes)))]
    for load in loads:
        load.flat[random.integers(load.size)] = 1.0
    if loads:
        loads += [np.tile(axis, (len(made.nodes), 1)) for axis in np.eye(3)]
    found = []
    for load in loads:
        balance = system.forces(made.field(load))
        balance[made.nodes] -= load
        balance[fixed] = 0.0
        found.append(float(np.linalg.norm(balance) / np.linalg.norm(load)))
    return max(float(np.median(found[:-3])), *found[-3:]) if found else 0.0


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
    arrays: dict[str, NDArray] = {
        "nodes": made.nodes,
        "free": made.free,
        "matrix": made.matrix,
        "fields": made.fields,
        "scales": made.scales,
    }
    return arrays, {"count": made.count, "rounding": made.rounding}


def _unpack(arrays: dict[str, NDArray], facts: dict[str, Any]) -> SurfaceCompliance:
    return SurfaceCompliance(
        **{name: arrays[name] for name in ("nodes", "free", "matrix", "fields", "scales")},
        count=int(facts["count"]),
        rounding=float(facts["rounding"]),
    )


_FORM = Form("compliance.json", _pack, _unpack)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _add_rows(fields, rows, weights, free, displacement):
    """Adds the weighted rows of fields (R, 3, F) to displacement (N, 3) of free (F,) nodes."""
    width = 1024  # nodes of a piece that stays in the fastest cache
    four = len(rows) // 4 * 4
    whole = np.empty((3, width))
    for begin in range(0, len(free), width):
        end = min(begin + width, len(free))
        for axis in range(3):
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
            for axis in range(3):
                displacement[free[begin + i], axis] += whole[axis, i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _add_scaled_rows(fields, scales, rows, weights, free, displacement):
    """As `_add_rows`, of integers with a scale for each of their blocks."""
    four = len(rows) // 4 * 4
    whole = np.empty((3, _BLOCK), np.float32)
    for block in range(scales.shape[2]):
        begin = block * _BLOCK
        end = min(begin + _BLOCK, len(free))
        for axis in range(3):
            piece = whole[axis, : end - begin]
            piece[:] = 0.0
            for m in range(0, four, 4):
                a = fields[rows[m], axis, begin:end]
                b = fields[rows[m + 1], axis, begin:end]
                c = fields[rows[m + 2], axis, begin:end]
                d = fields[rows[m + 3], axis, begin:end]
                p = np.float32(weights[m] * scales[rows[m], axis, block])
                q = np.float32(weights[m + 1] * scales[rows[m + 1], axis, block])
                r = np.float32(weights[m + 2] * scales[rows[m + 2], axis, block])
                s = np.float32(weights[m + 3] * scales[rows[m + 3], axis, block])
                for i in range(len(piece)):
                    piece[i] += (
                        p * np.float32(a[i])
                        + q * np.float32(b[i])
                        + r * np.float32(c[i])
                        + s * np.float32(d[i])
                    )
            for m in range(four, len(rows)):
                a = fields[rows[m], axis, begin:end]
                p = np.float32(weights[m] * scales[rows[m], axis, block])
                for i in range(len(piece)):
                    piece[i] += p * np.float32(a[i])
        for i in range(end - begin):
            for axis in range(3):
                displacement[free[begin + i], axis] += whole[axis, i]
