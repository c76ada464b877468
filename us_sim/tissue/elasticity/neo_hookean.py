"""Nearly incompressible neo-Hookean tissue without a matrix.

Linear tetrahedra have the energy of `neo_hookean_material`. The nodal part of `volumetric_split`
resists the average change of volume around each node:

    sum over tetrahedra e of V (mu/2 (|F|^2 - 3) - mu (J - 1) + element/2 (J - 1)^2)
    + 1/2 sum over nodes a of C q^2,   C = sum of c over a's e,   q = sum of c (J - 1) / C,

with c = V nodal / 4, plus the term against being crushed. Tetrahedra with a lumen have its energy
in place of all but the shear's. Without them, linearised at rest, it is linear elasticity with the
same split. Kernels gather nodes into rows of `LANES` tetrahedra, whose loops LLVM vectorises.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from us_sim.errors import SolverError
from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.neo_hookean_cells import make_cell_sums
from us_sim.tissue.elasticity.neo_hookean_material import (
    INLINED,
    LOOP,
    ONE,
    barrier_term,
    bulk_slope,
    cofactor_change,
    diagonal_block,
    energy_density,
    neo_hookean_constants,
    piola_stress,
    stress_rise,
    volume_change,
    volume_slope,
)
from us_sim.tissue.elasticity.nodal_sums import (
    LANES,
    OUT,
    ROWS,
    SHAPE,
    SUMS,
    NodalSums,
    gather_scalar,
    gather_vector,
    get_nine,
    get_three,
    gradient,
    lumen_energy_at,
    pack_groups,
    pack_lanes,
    put_forces,
    put_nine,
    put_six,
    scatter_scalar,
    scatter_vector,
)
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_ROW = np.int64(LANES)  # no literal, for which numba would compile `lumen_energy_at` again
# Rows of the constants behind the shape gradients: V mu, V element, V nodal / 4; and their
# number.
_SHEAR, _ELEMENT, _NODAL, _WALL, _CONSTANTS = (
    SHAPE + 9,
    SHAPE + 10,
    SHAPE + 11,
    SHAPE + 12,
    SHAPE + 13,
)

# Rows that the tangent needs: the displacement's gradient, V (p - mu), V times the slope of p by
# J; and their number.
_GRADIENT, _K, _BULK, _TANGENT = np.int64(0), 9, 10, 11
_ENERGY = OUT + 12  # Row of energies, behind those of forces


@njit(**INLINED)
def _nodal_pressure(lanes, constants, w):
    """Return the nodal weight times the sum of the nodes' values that `gather_scalar` has made."""
    v = SUMS * LANES + w
    first, second = lanes[v] + lanes[v + LANES], lanes[v + 2 * LANES] + lanes[v + 3 * LANES]
    return constants[_NODAL * LANES + w] * (first + second)


@njit(**INLINED)
def _pressure(h, lanes, rows, w):
    """Return V times the slope by J of all energy but the shear's and lumens'."""
    change = volume_change(h)
    own = rows[_ELEMENT * LANES + w] * change + rows[_WALL * LANES + w] * barrier_term(change)[1]
    return own + _nodal_pressure(lanes, rows, w)


@njit(**LOOP)
def _volume_ratios(displacement, nodes, constants, lanes):
    smallest = np.inf
    inverted = 0
    for chunk in range(len(nodes)):
        gather_vector(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(LANES):
            lanes[OUT * LANES + w] = ONE + volume_change(gradient(lanes, rows, w))
        for w in range(LANES):
            ratio = lanes[OUT * LANES + w]
            if rows[_SHEAR * LANES + w] > 0:
                if ratio < smallest or np.isnan(ratio):
                    smallest = ratio
                if not ratio > 0:
                    inverted += 1
    return smallest, inverted


@njit(**LOOP)
def _volume_changes(displacement, nodes, constants, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(nodes)):
        gather_vector(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(LANES):
            h = gradient(lanes, rows, w)
            lanes[OUT * LANES + w] = rows[_NODAL * LANES + w] * volume_change(h)
        scatter_scalar(lanes, nodes[chunk], nodal)


@njit(**LOOP)
def _energy_and_forces(displacement, nodal, nodes, constants, lumens, lanes, forces):
    forces[:, :] = 0
    total = 0.0
    for chunk in range(len(nodes)):
        gather_vector(displacement, nodes[chunk], lanes)
        if len(nodal):
            gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(LANES):
            h = gradient(lanes, rows, w)
            lanes[_ENERGY * LANES + w] = energy_density(
                h, rows[_SHEAR * LANES + w], rows[_ELEMENT * LANES + w], rows[_WALL * LANES + w]
            )
            put_forces(
                piola_stress(h, rows[_SHEAR * LANES + w], _pressure(h, lanes, rows, w)),
                rows,
                w,
                lanes,
            )
        if lumens[0][chunk] >= 0:
            lumen = lumens[1][lumens[0][chunk]]
            for w in range(LANES):
                h = gradient(lanes, rows, w)
                energy, slope, _ = lumen_energy_at(h, lumen, w, _ROW)
                lanes[_ENERGY * LANES + w] += energy
                pressure = _pressure(h, lanes, rows, w) + slope
                put_forces(piola_stress(h, rows[_SHEAR * LANES + w], pressure), rows, w, lanes)
        for w in range(LANES):
            total += lanes[_ENERGY * LANES + w]
        scatter_vector(lanes, nodes[chunk], forces)
    return total


@njit(**LOOP)
def _linearise(displacement, nodal, nodes, constants, lumens, lanes, tangent):
    for chunk in range(len(nodes)):
        gather_vector(displacement, nodes[chunk], lanes)
        if len(nodal):
            gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            h = gradient(lanes, rows, w)
            put_nine(h, kept, _GRADIENT, w)
            kept[_K * LANES + w] = _pressure(h, lanes, rows, w) - rows[_SHEAR * LANES + w]
            kept[_BULK * LANES + w] = bulk_slope(
                volume_change(h), rows[_ELEMENT * LANES + w], rows[_WALL * LANES + w]
            )
        if lumens[0][chunk] >= 0:
            lumen = lumens[1][lumens[0][chunk]]
            for w in range(LANES):
                _, pressure, slope = lumen_energy_at(gradient(lanes, rows, w), lumen, w, _ROW)
                kept[_K * LANES + w] += pressure
                kept[_BULK * LANES + w] += slope


@njit(**LOOP)
def _volume_slopes(change, nodes, constants, tangent, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(nodes)):
        gather_vector(change, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            d = gradient(lanes, rows, w)
            h = get_nine(kept, _GRADIENT, w)
            lanes[OUT * LANES + w] = rows[_NODAL * LANES + w] * volume_slope(h, d)
        scatter_scalar(lanes, nodes[chunk], nodal)


@njit(**LOOP)
def _tangent_product(change, nodal, nodes, constants, tangent, lanes, product):
    product[:, :] = 0
    for chunk in range(len(nodes)):
        gather_vector(change, nodes[chunk], lanes)
        if len(nodal):
            gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            d = gradient(lanes, rows, w)
            h = get_nine(kept, _GRADIENT, w)
            shear, nodal_rise = rows[_SHEAR * LANES + w], _nodal_pressure(lanes, rows, w)
            bulk, k = kept[_BULK * LANES + w], kept[_K * LANES + w]
            put_forces(stress_rise(h, d, shear, bulk, k, nodal_rise), rows, w, lanes)
        scatter_vector(lanes, nodes[chunk], product)


@njit(**LOOP)
def _diagonal_blocks(nodes, constants, tangent, lanes, blocks):
    blocks[:, :] = 0
    for chunk in range(len(nodes)):
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            h = get_nine(kept, _GRADIENT, w)
            c = cofactor_change(h)
            shear = rows[_SHEAR * LANES + w]
            bulk = kept[_BULK * LANES + w]
            x, y, z = (
                get_three(rows, SHAPE, w),
                get_three(rows, SHAPE + 3, w),
                get_three(rows, SHAPE + 6, w),
            )
            o = (-(x[0] + y[0] + z[0]), -(x[1] + y[1] + z[1]), -(x[2] + y[2] + z[2]))
            put_six(diagonal_block(o, c, shear, bulk), lanes, OUT, w)
            put_six(diagonal_block(x, c, shear, bulk), lanes, OUT + 6, w)
            put_six(diagonal_block(y, c, shear, bulk), lanes, OUT + 12, w)
            put_six(diagonal_block(z, c, shear, bulk), lanes, OUT + 18, w)
        for corner in range(4):
            at = nodes[chunk, corner * LANES : (corner + 1) * LANES]
            for entry in range(6):
                values = blocks[entry]
                added = lanes[(OUT + 6 * corner + entry) * LANES :]
                for w in range(LANES):
                    values[at[w]] += added[w]


def make_tetrahedra_sums(
    mesh: TetrahedralMesh, materials: TissueMaterials, dtype: DTypeLike
) -> NodalSums:
    """Make the sums over the tetrahedra of any mesh at its nodes."""
    made = neo_hookean_constants(mesh, materials)
    rows = np.empty((len(mesh.tetrahedra), _CONSTANTS))
    rows[:, SHAPE:_SHEAR] = shape_gradients(mesh)[:, 1:].reshape(-1, 9)
    rows[:, _SHEAR] = mesh.volumes * made.shear
    rows[:, _ELEMENT] = mesh.volumes * made.element
    rows[:, _NODAL] = mesh.volumes * made.nodal / 4
    rows[:, _WALL] = mesh.volumes * made.wall
    # Lanes beyond the last tetrahedron name node 0 and have no stiffness.
    nodes = pack_lanes(mesh.tetrahedra.astype(np.uint32))
    return NodalSums(
        _volume_ratios,
        _volume_changes,
        _energy_and_forces,
        _linearise,
        _volume_slopes,
        _tangent_product,
        _diagonal_blocks,
        nodes=nodes,
        constants=pack_lanes(rows).astype(dtype),
        lumens=pack_groups(made.lumen_energies(mesh)[:, None], dtype),
        tangent=np.zeros((len(nodes), _TANGENT * LANES), dtype=dtype),
        lanes=np.zeros(ROWS * LANES, dtype=dtype),
    )


class NeoHookean:
    """Energy, forces and tangent of a mesh whose fields are (3, N) arrays of one dtype.

    Every node has its column, fixed ones too. Arguments must be C-contiguous and of ``dtype``.
    In single precision the error of the forces is that of a displacement rounded to about 1e-6, so
    a residual at Poisson's ratios above 0.499 needs double precision.

    Args:
        mesh: in frame ``patient``.
        materials: of each tetrahedron.
        dtype: float32, or float64.

    Raises:
        SolverError: another dtype; and from every method, a field of another shape or dtype.
    """

    def __init__(
        self, mesh: TetrahedralMesh, materials: TissueMaterials, dtype: DTypeLike = np.float32
    ) -> None:
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.float32, np.float64):
            raise SolverError(f"the neo-Hookean tissue is in {dtype}: give float32 or float64")
        self.count = len(mesh.nodes)  # N
        sums = make_tetrahedra_sums if mesh.planes is None else make_cell_sums
        self._sums: NodalSums = sums(mesh, materials, self.dtype)
        weight = neo_hookean_constants(mesh, materials).nodal * mesh.volumes / 4
        total = np.zeros(self.count)
        np.add.at(total, mesh.tetrahedra, weight[:, None])
        self._averaged = bool(total.any())
        with np.errstate(divide="ignore"):
            self._inverse = np.where(total > 0, 1 / total, 0).astype(self.dtype)
        self._nodal = np.zeros(self.count if self._averaged else 0, dtype=self.dtype)
        self._nodal_blocks = _nodal_blocks(mesh, weight, total).astype(self.dtype)
        self.linearise(np.zeros((3, self.count), dtype=self.dtype))

    def compute_energy(self, displacement: NDArray) -> float:
        """Return the energy in J, summed in double precision."""
        return self.compute_energy_and_forces(
            displacement, np.empty(displacement.shape, self.dtype)
        )

    def compute_forces(self, displacement: NDArray, out: NDArray | None = None) -> NDArray:
        """Return (3, N) N, the slope of the energy: external forces that hold the nodes there."""
        out = np.empty(displacement.shape, self.dtype) if out is None else out
        self.compute_energy_and_forces(displacement, out)
        return out

    def compute_energy_and_forces(self, displacement: NDArray, out: NDArray) -> float:
        """Return the energy in J; overwrite ``out`` with its slope (3, N) N."""
        self._require(displacement)
        self._require(out)
        sums, energy = self._sums, 0.0
        if self._averaged:
            sums.volume_changes(displacement, sums.nodes, sums.constants, sums.lanes, self._nodal)
            energy = float(
                np.einsum("i,i,i->", self._nodal, self._nodal, self._inverse, dtype=np.float64) / 2
            )
            self._nodal *= self._inverse
        energy += sums.energy_and_forces(
            displacement, self._nodal, sums.nodes, sums.constants, sums.lumens, sums.lanes, out
        )
        return energy

    def linearise(self, displacement: NDArray) -> None:
        """Set the displacement (3, N) m of `tangent_product` and `diagonal_blocks`."""
        self._require(displacement)
        sums = self._sums
        if self._averaged:
            sums.volume_changes(displacement, sums.nodes, sums.constants, sums.lanes, self._nodal)
            self._nodal *= self._inverse
        arrays = sums.nodes, sums.constants, sums.lumens, sums.lanes, sums.tangent
        sums.linearise(displacement, self._nodal, *arrays)

    def tangent_product(self, change: NDArray, out: NDArray | None = None) -> NDArray:
        """Return (3, N) N, the slope of the forces times a change (3, N) of the displacement."""
        self._require(change)
        out = np.empty_like(change) if out is None else out
        self._require(out)
        sums = self._sums
        arrays = sums.nodes, sums.constants, sums.tangent, sums.lanes
        if self._averaged:
            sums.volume_slopes(change, *arrays, self._nodal)
            self._nodal *= self._inverse
        sums.tangent_product(change, self._nodal, *arrays, out)
        return out

    def diagonal_blocks(self) -> NDArray:
        """Return (6, N) N/m, entries xx, xy, xz, yy, yz, zz of each node's block of the tangent.

        The nodal part of the bulk stiffness is counted as it is at rest.
        """
        blocks = np.empty((6, self.count), dtype=self.dtype)
        sums = self._sums
        sums.diagonal_blocks(sums.nodes, sums.constants, sums.tangent, sums.lanes, blocks)
        blocks += self._nodal_blocks
        return blocks

    def smallest_volume_ratio(self, displacement: NDArray) -> float:
        """Return the smallest J, a tetrahedron's volume over that at rest; NaN if any is NaN."""
        return self._volume_ratios(displacement)[0]

    def count_inverted(self, displacement: NDArray) -> int:
        """Count the tetrahedra whose J is not above zero."""
        return self._volume_ratios(displacement)[1]

    def _volume_ratios(self, displacement: NDArray) -> tuple[float, int]:
        self._require(displacement)
        sums = self._sums
        return sums.volume_ratios(displacement, sums.nodes, sums.constants, sums.lanes)

    def _require(self, field: NDArray) -> None:
        if (
            field.shape != (3, self.count)
            or field.dtype != self.dtype
            or not field.flags.c_contiguous
        ):
            raise SolverError(
                f"a field of the neo-Hookean tissue is {field.dtype} of shape {field.shape}: give "
                f"C-contiguous {self.dtype} of shape {(3, self.count)}"
            )


def _nodal_blocks(mesh: TetrahedralMesh, weight: NDArray, total: NDArray) -> NDArray:
    """Return (6, N) N/m, the diagonal blocks at rest of the nodal part of the bulk stiffness.

    Node n meets the average of each neighbour a, and its own, through s(a, n), the sum of c g over
    the tetrahedra of both, g being n's shape gradient there; its block is the sum over a of
    s s' / C(a).
    """
    count = len(mesh.nodes)
    blocks = np.zeros((6, count))
    if not total.any():
        return blocks
    pull = weight[:, None, None] * shape_gradients(mesh)
    average = np.repeat(mesh.tetrahedra, 4, axis=1).ravel().astype(np.int64)
    moved = np.tile(mesh.tetrahedra, (1, 4)).ravel()
    pairs, place = np.unique(average * count + moved, return_inverse=True)
    sums = np.empty((3, len(pairs)))
    for axis in range(3):
        sums[axis] = np.bincount(place, np.tile(pull[:, :, axis], (1, 4)).ravel(), len(pairs))
    stiff = total[pairs // count] > 0
    sums, pairs = sums[:, stiff], pairs[stiff]
    for entry, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
        products = sums[i] * sums[j] / total[pairs // count]
        blocks[entry] = np.bincount(pairs % count, products, count)
    return blocks
