"""Images that `us-sim evaluate slice` cuts of a block of speckle, and their true grey values.

The truth is brute force in float64 by NumPy and SciPy, which shares no arithmetic with the slicers:
every pixel is tried in every tetrahedron whose bounding box it lies in.

>>> from us_sim.evaluation.slice.cases import MAIN, dented, exact_slice
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> MAIN.name, len(MAIN.mesh().nodes), float(dented(np.zeros((1, 3)), 0.012)[0, 2])
('512 px, 32x16x16 nodes, pressed_12mm, straight', 8192, 0.012)
>>> to_patient = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> to_patient[:2, 3] = -0.02
>>> volume = Volume(np.tile(np.arange(50, dtype=np.uint8), (41, 41, 1)), to_patient)
>>> mesh = box_mesh([-0.02, 0.02], [-0.02, 0.02], [0.0, 0.02, 0.04])
>>> plane = LinearProbe(aperture=0.02, depth=0.02, columns=8, rows=5).plane(Pose())
>>> exact_slice(volume, mesh.nodes, mesh.tetrahedra, mesh.nodes * [1, 1, 0.5], plane).grey[:, 0]
array([ 4., 12., 20., 28., 36.])
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.evaluation.block import EXTENT, LARGEST_MESH, MESHES, block
from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]

SIZES = (256, 512, 1024)  # columns, and rows, of an image
DEPTHS = {"rest": 0.0, "pressed_12mm": 0.012, "pressed_30mm": 0.03}
"""m, by which the block is pressed."""

_BEYOND = 5e-3  # m of volume around the block, which does not deform
_VOXEL = 0.4e-3  # m
_WIDTH = 0.022  # m, standard deviation of the dent


@dataclass(frozen=True)
class _View:
    """Where the image lies and how it is turned, seen from where the probe stands."""

    words: str
    turned: float = 0.0  # degrees about the probe's axis
    tilted: float = 0.0  # degrees about the image's columns' direction, first
    beside: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, from where the probe stands
    on_faces: bool = False  # moved onto a layer of the mesh's faces


PLANES = {
    "straight": _View("in the probe's plane"),
    "oblique": _View("turned by 25° and tilted by 30°, from above the skin", 25, 30, (0, 0, -0.01)),
    "corner": _View("turned by 70°, tilted by 40°, out of the block", 70, 40, (0.06, 0.03, 0.01)),
    "faces": _View("along a layer of faces", on_faces=True),
}


@dataclass(frozen=True)
class Frame:
    """Nodes and plane of one image."""

    nodes: Array  # (N, 3) m, deformed
    plane: SlicePlane


@dataclass(frozen=True)
class Case:
    """An image of the block: how large, on which mesh, how deformed, and on which plane."""

    size: int
    counts: tuple[int, int, int]
    deformation: str
    plane: str

    @property
    def name(self) -> str:
        """The case in words, as on the screen."""
        counts = "x".join(map(str, self.counts))
        return f"{self.size} px, {counts} nodes, {self.deformation}, {self.plane}"

    def mesh(self) -> TetrahedralMesh:
        """The block at rest."""
        return block(self.counts)

    def frames(self, count: int) -> list[Frame]:
        """Images of a trembling probe, so that none repeats the one before."""
        rest = self.mesh().nodes
        depth, view = DEPTHS[self.deformation], PLANES[self.plane]
        found = []
        for number in range(count):
            nodes = dented(rest, depth * (1.0 - 0.01 * number))
            position = np.array(view.beside)
            position[2] += depth
            if view.on_faces:
                layers = rest[:, 1]
                position[1] = layers[np.abs(layers).argmin()]
            else:
                position += 0.2e-3 * number  # m
            pose = Pose(position, _turn(math.radians(view.turned), math.radians(view.tilted)))
            probe = LinearProbe(0.06, 0.08, self.size, self.size)
            found.append(Frame(nodes, probe.plane(pose)))
        return found


MAIN = Case(512, MESHES[-1], "pressed_12mm", "straight")  # the case by which methods are compared


def cases(quick: bool) -> list[Case]:
    """All that are cut.

    Every deformation on every plane in the middle size on the finest of the paper's meshes; every
    mesh with every deformation; every size on every mesh. The quick run leaves most of it out.
    """
    if quick:
        return [
            MAIN,
            replace(MAIN, deformation="rest", plane="faces"),
            replace(MAIN, deformation="pressed_30mm", plane="oblique"),
            replace(MAIN, size=SIZES[0]),
            replace(MAIN, size=SIZES[-1]),
            replace(MAIN, counts=MESHES[0]),
            replace(MAIN, counts=LARGEST_MESH),
        ]
    meshes = [*MESHES, LARGEST_MESH]
    found = [MAIN]
    found += [replace(MAIN, deformation=d, plane=p) for d in DEPTHS for p in PLANES]
    found += [replace(MAIN, counts=c, deformation=d) for c in meshes for d in DEPTHS]
    found += [replace(MAIN, counts=c, size=s) for c in meshes for s in SIZES]
    large = replace(MAIN, size=SIZES[-1], deformation="pressed_30mm")
    found += [replace(large, plane=p) for p in ("oblique", "corner")]
    return list(dict.fromkeys(found))


def dented(nodes: Array, depth: float) -> Array:
    """Nodes (N, 3) m of the block pressed by ``depth`` m in the middle of its top.

    A smooth field, so that nothing depends on a solver: down under a Gaussian dent that ends at
    the bottom, and aside halfway down.
    """
    height = EXTENT[2][1]
    below = nodes[:, 2:] / height
    dent = np.exp(-(nodes[:, :2] ** 2).sum(axis=1, keepdims=True) / (2.0 * _WIDTH**2))
    aside = 0.25 * depth / _WIDTH * nodes[:, :2] * 4.0 * below * (1.0 - below) ** 2
    return np.asarray(nodes + np.hstack([aside, depth * (1.0 - below) ** 2]) * dent)


@cache
def speckle(seed: int = 1) -> Volume:
    """The block's volume, and a little around it: speckle with balls and bright layers."""
    axes = _voxel_axes()
    generator = np.random.default_rng(seed)
    echo = generator.standard_normal([len(axis) for axis in axes], dtype=np.float32)
    for axis in range(3):
        echo = ndimage.correlate1d(echo, np.array([0.25, 0.5, 0.25], np.float32), axis)
    echo *= np.float32(60.0 / echo.std())
    grey = np.abs(echo, out=echo)
    for _ in range(40):
        centre = [generator.uniform(axis[0], axis[-1]) for axis in axes]
        radius = generator.uniform(3e-3, 9e-3)
        part = tuple(
            slice(*np.searchsorted(axis, [c - radius, c + radius]))
            for axis, c in zip(axes, centre, strict=True)
        )
        inside = [(axis[p] - c) ** 2 for axis, p, c in zip(axes, part, centre, strict=True)]
        x, y, z = np.ix_(*inside)
        grey[part][x + y + z < radius**2] *= np.float32(generator.choice([0.2, 2.0]))
    for depth in (0.008, 0.02, 0.035, 0.05, 0.07, 0.09):  # m below the skin
        grey[:, :, np.abs(axes[2] - depth) < 0.6e-3] *= np.float32(2.5)
    return _placed(np.minimum(grey, 255.0, out=grey).astype(np.uint8))


@cache
def black_and_white(seed: int = 1) -> Volume:
    """Of the same shape and place: every voxel black or white, so that a shift is seen at once."""
    shape = [len(places) for places in _voxel_axes()]
    bits = np.random.default_rng(seed).integers(0, 2, shape, dtype=np.uint8)
    return _placed(np.multiply(bits, 255, out=bits))


def _voxel_axes() -> list[Array]:
    """m, the centres of the voxels along x, y and z."""
    counts = (math.ceil((high - low + 2 * _BEYOND) / _VOXEL) for low, high in EXTENT)
    return [
        np.asarray(low - _BEYOND + _VOXEL * (np.arange(count) + 0.5))
        for (low, _), count in zip(EXTENT, counts, strict=True)
    ]


def _placed(voxels: NDArray[np.uint8]) -> Volume:
    placed = np.diag([_VOXEL, _VOXEL, _VOXEL, 1.0])
    placed[:3, 3] = [axis[0] for axis in _voxel_axes()]
    return Volume(voxels, placed)


def _turn(about_z: float, about_x: float) -> Array:
    """The quaternion (x, y, z, w) of a tilt about x, then a turn about z, both in radians."""
    sx, cx = math.sin(about_x / 2), math.cos(about_x / 2)
    sz, cz = math.sin(about_z / 2), math.cos(about_z / 2)
    return np.array([cz * sx, sz * sx, sz * cx, cz * cx])


_PAIRS = 1_000_000  # pairs of a pixel and a tetrahedron that are tried at once


@dataclass(frozen=True)
class ExactSlice:
    """The truth of every pixel of an image."""

    rest: Array  # (rows, columns, 3) m; NaN where there is nothing
    tissue: NDArray[np.bool_]  # (rows, columns): in the deformed mesh
    grey: Array  # (rows, columns)


def exact_slice(
    volume: Volume,
    rest_nodes: Array,
    tetrahedra: NDArray[np.int32],
    nodes: Array,
    plane: SlicePlane,
) -> ExactSlice:
    """The image of tissue with its nodes at ``nodes`` (N, 3) m, as `slicing.slicer` defines it."""
    pixels = plane.pixels()
    rest = _located(rest_nodes, tetrahedra, nodes, plane)
    tissue = ~np.isnan(rest[..., 0])
    rest[~tissue] = pixels[~tissue]
    if not tissue.all():
        was = ~np.isnan(_located(rest_nodes, tetrahedra, rest_nodes, plane)[..., 0])
        rest[was & ~tissue] = np.nan
    return ExactSlice(rest, tissue, sampled(volume, rest))


def sampled(volume: Volume, rest: Array) -> Array:
    """Trilinear grey values at ``rest`` (rows, columns, 3) m; 0 at NaN and beyond the volume."""
    index = rest @ volume.patient_to_index[:3, :3].T + volume.patient_to_index[:3, 3]
    beyond = ~((index >= -0.5) & (index <= np.array(volume.shape) - 0.5)).all(axis=-1)
    index[beyond] = 0.0
    grey = ndimage.map_coordinates(
        volume.intensities, np.moveaxis(index, -1, 0), np.float64, order=1, mode="nearest"
    )
    grey[beyond] = 0.0
    return np.asarray(grey)


def voxel_distance(volume: Volume, one: Array, other: Array) -> Array:
    """(rows, columns) voxels between two sets of positions (rows, columns, 3) m."""
    return np.asarray(np.linalg.norm((one - other) @ volume.patient_to_index[:3, :3].T, axis=-1))


def _located(
    rest_nodes: Array, tetrahedra: NDArray[np.int32], nodes: Array, plane: SlicePlane
) -> Array:
    """(rows, columns, 3) m at rest of every pixel in the mesh; NaN of the others."""
    placed = nodes @ plane.to_pixel[:, :3].T + plane.to_pixel[:, 3]  # column, row, height
    corners = placed[tetrahedra]
    low, high = corners.min(axis=1), corners.max(axis=1)
    last = np.array([plane.columns - 1, plane.rows - 1, 0])
    first = np.maximum(np.ceil(low[:, :2] - 1e-6), 0).astype(int)
    end = np.minimum(np.floor(high[:, :2] + 1e-6), last[:2]).astype(int) + 1
    near = ((low <= last + 1e-6) & (high >= -1e-6)).all(axis=1) & (end > first).all(axis=1)
    before = _determinants(rest_nodes, tetrahedra)
    upright = _determinants(nodes, tetrahedra) * np.sign(before) > 1e-6 * np.abs(before)
    chosen = np.flatnonzero(near & upright)

    found = np.full((plane.rows, plane.columns, 3), np.nan)
    counts = (end - first)[chosen].prod(axis=1)
    groups = np.searchsorted(np.cumsum(counts), np.arange(_PAIRS, counts.sum(), _PAIRS))
    for members in np.split(chosen, groups):
        width, height = (end - first)[members].T
        number = np.repeat(np.arange(len(members)), width * height)
        place = np.arange(len(number)) - np.repeat(
            np.cumsum(width * height) - width * height, width * height
        )
        row, column = np.divmod(place, width[number])
        column += first[members, 0][number]
        row += first[members, 1][number]
        edges = np.moveaxis(corners[members, 1:] - corners[members, :1], 1, 2)
        inverse = np.linalg.inv(edges)
        away = np.stack([column, row, np.zeros(len(row))], axis=1) - corners[members, 0][number]
        weights = np.einsum("pij,pj->pi", inverse[number], away)
        inside = (weights.min(axis=1) >= -1e-9) & (weights.sum(axis=1) <= 1.0 + 1e-9)
        number, weights = number[inside], weights[inside]
        origin = rest_nodes[tetrahedra[members]][number]
        found[row[inside], column[inside]] = origin[:, 0] + np.einsum(
            "pk,pki->pi", weights, origin[:, 1:] - origin[:, :1]
        )
    return found


def _determinants(nodes: Array, tetrahedra: NDArray[np.int32]) -> Array:
    """(M,) m3, six times the signed volumes."""
    corners = nodes[tetrahedra]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))
