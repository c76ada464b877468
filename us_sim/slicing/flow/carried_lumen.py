"""A vessel's lumen as the tissue carries it, and the voxels' places in it.

Points on rings around each station move with the tissue's tetrahedra. The area of a ring is the
component of its polygon's area vector along the vessel's tangent. Blood flows fastest on the axis
and stands at the wall, as the square of the radial coordinate (Poiseuille).
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.cache import Form, kept
from us_sim.kernels import njit
from us_sim.slicing.flow.lumen import DIRECTIONS, Lumen, lumen_of
from us_sim.tissue.mesh.embedding import locate
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.volume.volume import Volume

_RINGS = 4  # rings around a station that share its area at rest evenly
_FRACTIONS = np.sqrt(np.arange(_RINGS + 1) / _RINGS)
_REACH = 2e-3
"""m outside the tissue beyond which a vessel stays where it is, as the volume does there."""


@dataclass(frozen=True, eq=False)
class LumenNow:
    """A lumen at one moment, at its S stations."""

    tangents: NDArray[np.float64]  # (S, 3), unit vectors along the vessel
    areas: NDArray[np.float64]  # (S,) m², across it
    filled: NDArray[np.float64]  # (S,) m², the flow over the velocity on the axis


class CarriedLumen:
    """Carries a lumen with the tissue.

    Args:
        mesh: of the tissue at rest; None for a lumen that stays as it is.
    """

    def __init__(self, lumen: Lumen, mesh: TetrahedralMesh | None) -> None:
        points = lumen.rings(_FRACTIONS).reshape(-1, 3)
        self._points = np.ascontiguousarray(points)
        self._rest_areas = lumen.areas
        self._nodes = np.zeros((len(points), 4), dtype=np.int32)
        self._weights = np.zeros((len(points), 4))
        self._rest_nodes = np.zeros((1, 3))
        if mesh is not None:
            where = locate(mesh, points)
            self._nodes = np.ascontiguousarray(mesh.tetrahedra[where.tetrahedra])
            self._weights = where.weights * (where.outside < _REACH)[:, None]
            self._rest_nodes = mesh.nodes
        self._rest_polygons = np.ones((len(lumen.areas), _RINGS))
        self._rest_polygons = self._measured(self._rest_nodes)[1]
        self.rest = self.carry(self._rest_nodes)

    def carry(self, nodes: NDArray[np.float64]) -> LumenNow:
        """The lumen with the tissue's nodes at ``nodes`` (N, 3) m."""
        tangents, polygons = self._measured(nodes)
        within = self._rest_areas[:, None] * _FRACTIONS[1:] ** 2
        within *= np.maximum(polygons, 0.0) / self._rest_polygons
        # Between two rings the profile falls evenly with the area at rest.
        profile = 1.0 - 0.5 * (_FRACTIONS[1:] ** 2 + _FRACTIONS[:-1] ** 2)
        between = np.maximum(np.diff(within, axis=1, prepend=0.0), 0.0)
        return LumenNow(tangents, within[:, -1], between @ profile)

    def _measured(
        self, nodes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Tangents (S, 3), and areas (S, rings) m² of the polygons across them."""
        stations = len(self._rest_areas)
        tangents, polygons = np.empty((stations, 3)), np.empty((stations, _RINGS))
        moved = np.ascontiguousarray(nodes, dtype=np.float64) - self._rest_nodes
        _measure(self._points, self._nodes, self._weights, moved, tangents, polygons)
        return tangents, polygons


@njit(cache=True, nogil=True, error_model="numpy")
def _measure(points, nodes, weights, moved, tangents, polygons):
    """Fills tangents (S, 3) and polygons (S, rings).

    Args:
        points: (S * (rings + 1) * directions, 3) m, at rest; the first ring is the centre.
        nodes, weights: (points, 4), of the tetrahedron that each goes with.
        moved: (N, 3) m, displacements of the nodes.
    """
    stations, rings = polygons.shape
    each = (rings + 1) * DIRECTIONS
    place = np.empty((each * stations, 3))
    for p in range(len(points)):
        for x in range(3):
            place[p, x] = points[p, x] + (
                weights[p, 0] * moved[nodes[p, 0], x] + weights[p, 1] * moved[nodes[p, 1], x]
                + weights[p, 2] * moved[nodes[p, 2], x] + weights[p, 3] * moved[nodes[p, 3], x]
            )  # fmt: skip
    area = np.empty(3)
    for s in range(stations):
        before = max(s - 1, 0) * each
        after = min(s + 1, stations - 1) * each
        length = 0.0
        for x in range(3):
            tangents[s, x] = place[after, x] - place[before, x]
            length += tangents[s, x] ** 2
        for x in range(3):
            tangents[s, x] /= max(np.sqrt(length), 1e-12)
        c = place[s * each]
        for k in range(rings):
            first = s * each + (k + 1) * DIRECTIONS
            area[:] = 0.0
            for j in range(DIRECTIONS):
                a = place[first + j]
                b = place[first + (j + 1) % DIRECTIONS]
                area[0] += (a[1] - c[1]) * (b[2] - c[2]) - (a[2] - c[2]) * (b[1] - c[1])
                area[1] += (a[2] - c[2]) * (b[0] - c[0]) - (a[0] - c[0]) * (b[2] - c[2])
                area[2] += (a[0] - c[0]) * (b[1] - c[1]) - (a[1] - c[1]) * (b[0] - c[0])
            polygons[s, k] = 0.5 * (
                area[0] * tangents[s, 0] + area[1] * tangents[s, 1] + area[2] * tangents[s, 2]
            )


_WAY = 1  # raised when another lumen or map is made of the same voxels
_OUTSIDE = 3.0  # radial coordinate that is well outside the wall
_MARGIN = 2  # voxels beyond the wall in which coordinates are known


@dataclass(frozen=True, eq=False)
class LumenMap:
    """Place along a vessel, and offset across it as `Lumen.locate` says, of voxels around it.

    The offset is kept and not the radial coordinate, since it is as good as linear from voxel to
    voxel.
    """

    station: NDArray[np.float32]  # (I, J, K)
    offset: NDArray[np.float32]  # (I, J, K, 2)
    corner: NDArray[np.int64]  # (3,), the volume's voxel that cell (0, 0, 0) is


def mapped_lumen(volume: Volume, label: int) -> tuple[Lumen, LumenMap]:
    """The lumen of a label, and the map of the voxels around it; from the cache if it is there.

    Raises:
        VolumeError: as `lumen_of`.
    """
    assert volume.labels is not None
    inside = volume.labels == label
    about = hashlib.sha256(np.packbits(inside))
    about.update(repr((_WAY, inside.shape, volume.index_to_patient.tolist())).encode())

    def make() -> tuple[Lumen, LumenMap]:
        lumen = lumen_of(inside, volume.index_to_patient)
        return lumen, _map(lumen, inside, volume.index_to_patient)

    return kept(f"lumen-{about.hexdigest()[:16]}", _FORM, make)


def _map(lumen: Lumen, inside: NDArray[np.bool_], to_patient: NDArray[np.float64]) -> LumenMap:
    voxels = np.argwhere(inside)
    low, high = voxels.min(axis=0) - _MARGIN, voxels.max(axis=0) + _MARGIN + 1
    shape = tuple(high - low)
    index = np.indices(shape).reshape(3, -1).T + low
    station, offset = lumen.locate(index @ to_patient[:3, :3].T + to_patient[:3, 3])
    return LumenMap(
        station.astype(np.float32).reshape(shape),
        np.clip(offset, -_OUTSIDE, _OUTSIDE).astype(np.float32).reshape(*shape, 2),
        low,
    )


def _pack(found: tuple[Lumen, LumenMap]) -> tuple[dict[str, NDArray], dict[str, Any]]:
    lumen, places = found
    arrays: dict[str, NDArray] = {**vars(lumen), **vars(places)}
    return {name: arrays[name] for name in (*_OF_LUMEN, *_OF_MAP)}, {}


def _unpack(arrays: dict[str, NDArray], _: dict[str, Any]) -> tuple[Lumen, LumenMap]:
    own = {name: np.array(array) for name, array in arrays.items()}  # kernels take no read-only
    return (
        Lumen(**{name: own[name] for name in _OF_LUMEN}),
        LumenMap(**{name: own[name] for name in _OF_MAP}),
    )


_OF_LUMEN = ("centres", "tangents", "across", "radii")
_OF_MAP = ("station", "offset", "corner")
_FORM = Form("lumen.json", _pack, _unpack)
