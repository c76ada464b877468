"""Displacement fields of forces on a surface, compressed to products of low rank.

A block of neighbouring nodes moves alike under all forces that are some way off. So the fields of
the forces on a patch of the surface in a block are kept as a product of low rank, its singular
vectors (W. Hackbusch, A sparse matrix arithmetic based on H-matrices, Computing 62, 1999). Patches
are as large as pays: two halves are joined where their forces together need clearly fewer vectors
than one by one, which is far from the block; next to it they stay small, of nearly full rank.
Nothing is assumed about the mesh or its materials.

Reading the vectors of the blocks is most of the time. So they are integers with a scale each: of 16
bits, and the many with small singular values of 8 bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.kernels import njit

_BLOCK = 512  # nodes at most of a block
_CHUNK = 64  # nodes at most for whose forces the fields are made at once
_PATCH = 32  # nodes at most of the smallest patches
# Two patches are joined if together they need this many vectors over those one by one, or fewer:
# a block next to one of them that is not loaded need not be read.
_GAIN = 0.75
# Numbers of a vector beside each other, those of the next one after them: read in line, and added
# up in registers.
_TILE = 64
# Singular values up to this many times the tolerance are of vectors of 8 bits, whose rounding is
# then below the tolerance.
_MINOR = 100
Solve = Callable[[NDArray[np.int64]], NDArray[np.floating]]


@dataclass(frozen=True, eq=False)
class LowRankFields:
    """Displacements of F nodes by each of 3S unit forces, as P products of two matrices.

    A right matrix turns the forces on a patch into weights of the vectors in the left one. Those of
    all blocks for which a patch is the same are beside each other, so that they are read in long
    rows.
    """

    nodes: NDArray[np.int32]  # (F,), of the fields, blocks together
    blocks: NDArray[np.int64]  # (B + 1,), where in the nodes each block begins
    products: NDArray[np.int64]  # (B + 1,), where in the three below those of each block begin
    patch: NDArray[np.int64]  # (P,), whose forces
    weights: NDArray[np.int64]  # (P, 3), among all patches' its first, first major, and last one
    place: NDArray[np.int64]  # (P, 2), where in the minor and the major left vectors it begins
    minor: NDArray[np.int8]  # of each product, (tiles of 3 nodes of the block, vectors, _TILE)
    major: NDArray[np.int16]  # likewise
    order: NDArray[np.int32]  # (S,), nodes with forces, patches together
    patches: NDArray[np.int64]  # (Q, 2), first and last in the order; patches overlap
    columns: NDArray[np.int64]  # (Q + 1,), where in the weights those of each patch begin
    rows: NDArray[np.int64]  # (Q,), where in the right ones it begins
    right: NDArray[np.float32]  # m/N, of each patch, (3 nodes of the patch, its weights)

    def __post_init__(self) -> None:
        # Always read-only, as from the cache: numba would compile the kernel again for others.
        for array in vars(self).values():
            array.flags.writeable = False

    @classmethod
    def compress(
        cls,
        points: NDArray[np.float64],
        nodes: NDArray[np.integer],
        surface: NDArray[np.float64],
        solve: Solve,
        tolerance: float,
    ) -> LowRankFields:
        """The fields at ``nodes`` (F,) of forces on S nodes.

        Args:
            points: (N, 3) m, by which nodes are put into blocks.
            surface: (S, 3) m, where the forces are.
            solve: the (N, 3, 3K) m/N fields of unit forces on K of the S nodes.
            tolerance: singular values that are left out, over the largest displacement that a force
                causes.
        """
        nodes = nodes[_halved(points[nodes], _BLOCK)]
        order = _halved(surface, _PATCH)
        compression = _Compression(nodes, order, solve, tolerance)
        compression.run()
        return compression.packed()

    def add(self, forces: NDArray[np.float64], displacement: NDArray[np.floating]) -> None:
        """Add the displacement by forces (3S,) N to displacement (N, 3) m."""
        ordered = forces.reshape(-1, 3)[self.order].astype(np.float32)
        weights, loaded = _weights(self.patches, self.columns, self.rows, self.right, ordered)
        _add_products(
            *(self.nodes, self.blocks, self.products, self.patch, self.weights, self.place),
            *(self.minor, self.major, weights, loaded, displacement),
        )


@dataclass(eq=False)
class _Product:
    """The fields in one block of the forces on a patch."""

    first: int
    last: int
    left: NDArray[np.float32]  # (3 nodes of the block, rank), of ascending singular values
    right: NDArray[np.float32]  # (rank, 3 nodes of the patch), orthonormal rows

    def minors(self, bound: float) -> int:
        """How many singular values are below a bound."""
        return int((np.linalg.norm(self.left, axis=0) < bound).sum())


class _Compression:
    def __init__(
        self, nodes: NDArray[np.integer], order: NDArray[np.int64], solve: Solve, tolerance: float
    ) -> None:
        self._nodes, self._order, self._solve = nodes, order, solve
        self._tolerance = tolerance
        self._blocks = _starts([len(block) for block in _ranges(len(nodes), _BLOCK)])
        self._largest = np.zeros(3 * len(order), np.float32)  # m/N, displacement by each force
        self._done: list[list[_Product]] = [[] for _ in self._blocks[1:]]

    def run(self) -> None:
        """Compress the fields of all forces."""
        if len(self._order):
            for block, product in enumerate(self._compress(0, len(self._order))):
                self._finish(block, product)

    def _compress(self, first: int, last: int) -> list[_Product | None]:
        """For each block the product of these forces; None where parts of them are done."""
        if last - first <= _CHUNK:
            fields = self._solve(self._order[first:last])
            fields = fields[self._nodes]
            largest = np.abs(fields).max(axis=(0, 1))
            self._largest[3 * first : 3 * last] = largest
            fields /= largest
            return [
                self._split(block, fields[begin:end].reshape(3 * (end - begin), -1), first, last)
                for block, (begin, end) in enumerate(
                    zip(self._blocks, self._blocks[1:], strict=False)
                )
            ]
        middle = (first + last) // 2
        halves = zip(self._compress(first, middle), self._compress(middle, last), strict=True)
        return [self._joined(block, *pair) for block, pair in enumerate(halves)]

    def _split(self, block: int, fields: NDArray, first: int, last: int) -> _Product | None:
        if last - first <= _PATCH:
            return _Product(first, last, *self._truncated(fields))
        middle = (first + last) // 2
        here = 3 * (middle - first)
        return self._joined(
            block,
            self._split(block, fields[:, :here], first, middle),
            self._split(block, fields[:, here:], middle, last),
        )

    def _joined(self, block: int, one: _Product | None, two: _Product | None) -> _Product | None:
        """The product of two patches; None, and they are done, if that does not pay."""
        if one is not None and two is not None:
            both = np.hstack([one.left, two.left])
            left, turn = self._truncated(both)
            if left.shape[1] <= _GAIN * both.shape[1]:
                rank = len(one.right)
                right = np.hstack([turn[:, :rank] @ one.right, turn[:, rank:] @ two.right])
                return _Product(one.first, two.last, left, right)
        self._finish(block, one)
        self._finish(block, two)
        return None

    def _truncated(self, matrix: NDArray) -> tuple[NDArray, NDArray]:
        """Left and right factors, without singular values below the tolerance."""
        exact = matrix.astype(np.float64)
        squares, vectors = np.linalg.eigh(exact.T @ exact)
        kept = vectors[:, squares > self._tolerance**2].astype(np.float32)
        return matrix.astype(np.float32) @ kept, np.ascontiguousarray(kept.T)

    def _finish(self, block: int, product: _Product | None) -> None:
        if product is None or product.left.size == 0:
            return
        self._done[block].append(product)

    def packed(self) -> LowRankFields:
        """All products, one after another."""
        products = [product for done in self._done for product in done]
        ends = np.array([(p.first, p.last) for p in products], np.int64).reshape(-1, 2)
        patches, patch = np.unique(ends, axis=0, return_inverse=True)
        ranks = np.array([len(p.right) for p in products], np.int64)
        by_patch = np.argsort(patch, kind="stable")
        last = np.empty_like(ranks)
        last[by_patch] = np.cumsum(ranks[by_patch])
        columns = _starts(np.bincount(patch, ranks, len(patches)))
        rows = _starts(3 * (patches[:, 1] - patches[:, 0]) * np.diff(columns))
        minors = np.array([p.minors(_MINOR * self._tolerance) for p in products], np.int64)
        sizes = np.array([_padded(len(p.left)) for p in products], np.int64)
        place = np.column_stack([_starts(sizes * minors), _starts(sizes * (ranks - minors))])
        minor, major = np.empty(place[-1, 0], np.int8), np.empty(place[-1, 1], np.int16)
        right = np.empty(rows[-1], np.float32)
        for p, product in enumerate(products):
            here, end = place[p : p + 2]
            one, one_scale = _tiles(product.left[:, : minors[p]], np.int8)
            two, two_scale = _tiles(product.left[:, minors[p] :], np.int16)
            minor[here[0] : end[0]], major[here[1] : end[1]] = one, two
            scale = np.append(one_scale, two_scale)
            largest = self._largest[3 * product.first : 3 * product.last, None]
            q = patch[p]
            whole = right[rows[q] : rows[q + 1]].reshape(len(largest), -1)
            after = last[p] - columns[q]
            whole[:, after - ranks[p] : after] = product.right.T * scale * largest
        return LowRankFields(
            self._nodes.astype(np.int32),
            self._blocks,
            _starts([len(done) for done in self._done]),
            patch.astype(np.int64),
            np.column_stack([last - ranks, last - ranks + minors, last]),
            place[:-1],
            minor,
            major,
            self._order.astype(np.int32),
            patches,
            columns,
            rows[:-1],
            right,
        )


def _tiles(vectors: NDArray[np.float32], kind: type) -> tuple[NDArray, NDArray[np.float32]]:
    """Columns as integers (tiles, columns, _TILE), flat, and the scale of each."""
    scale = np.abs(vectors).max(axis=0) / np.iinfo(kind).max
    rounded = np.zeros((_padded(len(vectors)), len(scale)))
    np.rint(vectors / scale, out=rounded[: len(vectors)])
    tiles = rounded.reshape(len(rounded) // _TILE, _TILE, len(scale)).transpose(0, 2, 1)
    return tiles.astype(kind).ravel(), scale


def _padded(count: int) -> int:
    return -(-count // _TILE) * _TILE


def _starts(lengths: ArrayLike) -> NDArray[np.int64]:
    """Starts of consecutive pieces of these lengths, and the end of the last."""
    return np.append(0, np.cumsum(lengths)).astype(np.int64)


def _ranges(count: int, largest: int) -> list[range]:
    """The numbers below count, halved until there are at most ``largest`` in each range."""

    def halve(first: int, last: int) -> list[range]:
        if last - first <= largest:
            return [range(first, last)]
        middle = (first + last) // 2
        return halve(first, middle) + halve(middle, last)

    return halve(0, count)


def _halved(points: NDArray[np.float64], largest: int) -> NDArray[np.int64]:
    """An order of points in which each of `_ranges` is of neighbours."""
    order = np.arange(len(points))

    def halve(first: int, last: int) -> None:
        if last - first <= largest:
            return
        here = order[first:last]
        axis = int(np.argmax(np.ptp(points[here], axis=0)))
        order[first:last] = here[np.argsort(points[here, axis], kind="stable")]
        middle = (first + last) // 2
        halve(first, middle)
        halve(middle, last)

    halve(0, len(points))
    return order


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _weights(patches, columns, rows, right, forces):
    """The weights of all vectors under forces (S, 3) in the order of the patches, and (Q,) whether
    a patch is loaded; weights of those that are not are undefined.
    """
    weights = np.empty(columns[-1], np.float32)
    loaded = np.zeros(len(patches), np.bool_)
    for q in range(len(patches)):
        first, last = patches[q]
        width = columns[q + 1] - columns[q]
        weight = weights[columns[q] : columns[q + 1]]
        for s in range(first, last):
            x, y, z = forces[s]
            if x == 0.0 and y == 0.0 and z == 0.0:
                continue
            if not loaded[q]:
                weight[:] = 0.0
                loaded[q] = True
            begin = rows[q] + 3 * (s - first) * width
            a = right[begin : begin + width]
            b = right[begin + width : begin + 2 * width]
            c = right[begin + 2 * width : begin + 3 * width]
            for r in range(width):
                weight[r] += x * a[r] + y * b[r] + z * c[r]
    return weights, loaded


@njit(cache=True, nogil=True, error_model="numpy")
def _add_products(
    nodes, blocks, products, patch, limits, place, minor, major, weights, loaded, displacement
):
    """Adds to displacement (N, 3) the weighted vectors of loaded patches."""
    moved = np.empty(3 * _BLOCK + _TILE, np.float32)
    for b in range(len(blocks) - 1):
        moved[:] = 0.0
        size = -(-3 * (blocks[b + 1] - blocks[b]) // _TILE) * _TILE
        for p in range(products[b], products[b + 1]):
            if loaded[patch[p]]:
                first, middle, last = limits[p]
                vectors = minor[place[p, 0] : place[p, 0] + (middle - first) * size]
                _add_vectors(vectors, weights[first:middle], moved[:size])
                others = major[place[p, 1] : place[p, 1] + (last - middle) * size]
                _add_vectors(others, weights[middle:last], moved[:size])
        for i in range(blocks[b], blocks[b + 1]):
            for axis in range(3):
                displacement[nodes[i], axis] += moved[3 * (i - blocks[b]) + axis]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _add_vectors(vectors, weight, moved):
    """Adds the weighted vectors (tiles of n, R, _TILE) to moved (n,)."""
    four = len(weight) // 4 * 4
    for tile in range(len(moved) // _TILE):
        sums = moved[tile * _TILE : (tile + 1) * _TILE]
        begin = tile * len(weight) * _TILE
        for r in range(0, four, 4):
            here = begin + r * _TILE
            a = vectors[here : here + _TILE]
            b = vectors[here + _TILE : here + 2 * _TILE]
            c = vectors[here + 2 * _TILE : here + 3 * _TILE]
            d = vectors[here + 3 * _TILE : here + 4 * _TILE]
            p, q, s, t = weight[r], weight[r + 1], weight[r + 2], weight[r + 3]
            for i in range(_TILE):
                sums[i] += (
                    p * np.float32(a[i])
                    + q * np.float32(b[i])
                    + s * np.float32(c[i])
                    + t * np.float32(d[i])
                )
        for r in range(four, len(weight)):
            a = vectors[begin + r * _TILE : begin + (r + 1) * _TILE]
            p = weight[r]
            for i in range(_TILE):
                sums[i] += p * np.float32(a[i])
