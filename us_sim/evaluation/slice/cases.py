"""Images of a block of speckle for `us-sim evaluate slice`.

>>> from us_sim.evaluation.slice.cases import MAIN, make_block_mesh, dent_nodes
>>> len(make_block_mesh(MAIN.counts).nodes), float(dent_nodes(np.zeros((1, 3)), 0.012)[0, 2])
(8192, 0.012)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from us_sim.evaluation.block import EXTENT, LARGEST_MESH, MESHES, make_block_mesh
from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]

SIZES = (256, 512, 1024)  # columns, and rows, of an image
DEPTHS = {"rest": 0.0, "pressed_12mm": 0.012, "pressed_30mm": 0.03}
"""m, by which the block is pressed."""

_BEYOND = 5e-3  # m of volume around the block, which does not deform
_VOXEL = 0.4e-3  # m
_WIDTH = 0.022  # m, standard deviation of the dent


class PlaneView(NamedTuple):
    """Place and rotation of an image, relative to the probe."""

    words: str
    turned: float = 0.0  # degrees about the probe's axis
    tilted: float = 0.0  # degrees about x, before the turn
    beside: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, from the probe


PLANES = {
    "straight": PlaneView("in the probe's plane"),
    "oblique": PlaneView(
        "turned by 25° and tilted by 30°, from above the skin", 25, 30, (0, 0, -0.01)
    ),
    "corner": PlaneView(
        "turned by 70°, tilted by 40°, out of the block", 70, 40, (0.06, 0.03, 0.01)
    ),
    "faces": PlaneView("along a layer of faces"),
}


class SliceFrame(NamedTuple):
    """Nodes and plane of one image."""

    nodes: Array  # (N, 3) m, deformed
    plane: SlicePlane


@dataclass(frozen=True)
class SliceCase:
    """An image of the block: its size, mesh, deformation and plane."""

    size: int  # pixels, of columns and rows
    counts: tuple[int, int, int]  # nodes of the mesh along x, y and z
    deformation: str  # of `DEPTHS`
    plane: str  # of `PLANES`

    def make_frames(self, count: int) -> list[SliceFrame]:
        """Make frames of a trembling probe, so that none repeats the one before."""
        rest = make_block_mesh(self.counts).nodes
        depth, view = DEPTHS[self.deformation], PLANES[self.plane]
        found = []
        for number in range(count):
            nodes = dent_nodes(rest, depth * (1.0 - 0.01 * number))
            position = np.array(view.beside)
            position[2] += depth
            if self.plane == "faces":
                layers = rest[:, 1]
                position[1] = layers[np.abs(layers).argmin()]
            else:
                position += 0.2e-3 * number  # m
            turn = Rotation.from_euler("xz", [view.tilted, view.turned], degrees=True)
            probe = LinearProbe(0.06, 0.08, self.size, self.size)
            found.append(SliceFrame(nodes, probe.make_plane(Pose(position, turn.as_quat()))))
        return found


MAIN = SliceCase(512, MESHES[-1], "pressed_12mm", "straight")
"""The case by which methods are compared."""


def list_cases(quick: bool) -> list[SliceCase]:
    """List the cases, the main one first; the quick run leaves most of them out."""
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


def dent_nodes(nodes: Array, depth: float) -> Array:
    """Press nodes (N, 3) m of the block by ``depth`` (m) in the middle of its top.

    The field is smooth, and needs no solver: down under a Gaussian dent that ends at the bottom,
    and aside halfway down.
    """
    height = EXTENT[2][1]
    below = nodes[:, 2:] / height
    dent = np.exp(-(nodes[:, :2] ** 2).sum(axis=1, keepdims=True) / (2.0 * _WIDTH**2))
    aside = 0.25 * depth / _WIDTH * nodes[:, :2] * 4.0 * below * (1.0 - below) ** 2
    return np.asarray(nodes + np.hstack([aside, depth * (1.0 - below) ** 2]) * dent)


@cache
def make_speckle() -> Volume:
    """Make the volume of the block and 5 mm around it: speckle with bright layers."""
    axes = [
        low - _BEYOND + _VOXEL * (np.arange(math.ceil((high - low + 2 * _BEYOND) / _VOXEL)) + 0.5)
        for low, high in EXTENT
    ]
    generator = np.random.default_rng(1)
    echo = generator.standard_normal([len(axis) for axis in axes], dtype=np.float32)
    for axis in range(3):
        echo = ndimage.correlate1d(echo, np.array([0.25, 0.5, 0.25], np.float32), axis)
    echo *= np.float32(60.0 / echo.std())
    grey = np.abs(echo, out=echo)
    for depth in (0.008, 0.02, 0.035, 0.05, 0.07, 0.09):  # m below the skin
        grey[:, :, np.abs(axes[2] - depth) < 0.6e-3] *= np.float32(2.5)
    placed = np.diag([_VOXEL, _VOXEL, _VOXEL, 1.0])
    placed[:3, 3] = [axis[0] for axis in axes]
    return Volume(np.minimum(grey, 255.0, out=grey).astype(np.uint8), placed)
