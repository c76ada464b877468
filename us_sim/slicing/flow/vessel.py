"""A vessel's lumen as the tissue carries it, and its flow: circulation and pulse.

Points on rings around each station move with the tissue's tetrahedra. The area of a ring is the
component of its polygon's area vector along the vessel's tangent. Blood flows fastest on the axis
and stands at the wall, as the square of the radial coordinate (Poiseuille).
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.cache import load_or_create
from us_sim.errors import SceneError, VolumeError
from us_sim.kernels import njit
from us_sim.slicing.flow.lumen import DIRECTIONS, Lumen, measure_lumen
from us_sim.slicing.settings import FlowSettings
from us_sim.tissue.mesh.embedding import locate_points
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.volume.volume import Volume

_RINGS = 4  # rings around a station that share its area at rest evenly
_FRACTIONS = np.sqrt(np.arange(_RINGS + 1) / _RINGS)
_REACH = 2e-3
"""m outside the tissue beyond which a vessel stays where it is, as the volume does there."""


@dataclass(frozen=True, eq=False)
class DeformedLumen:
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
        points = lumen.compute_rings(_FRACTIONS).reshape(-1, 3)
        self._points = np.ascontiguousarray(points)
        self._rest_areas = lumen.areas
        self._nodes = np.zeros((len(points), 4), dtype=np.int32)
        self._weights = np.zeros((len(points), 4))
        self._rest_nodes = np.zeros((1, 3))
        if mesh is not None:
            where = locate_points(mesh, points)
            self._nodes = np.ascontiguousarray(mesh.tetrahedra[where.tetrahedra])
            self._weights = where.weights * (where.outside < _REACH)[:, None]
            self._rest_nodes = mesh.nodes
        self._rest_polygons = np.ones((len(lumen.areas), _RINGS))
        self._rest_polygons = self._measured(self._rest_nodes)[1]
        self.rest = self.deform_lumen(self._rest_nodes)

    def deform_lumen(self, nodes: NDArray[np.float64]) -> DeformedLumen:
        """Return the lumen with the tissue's nodes at ``nodes`` (N, 3) m."""
        tangents, polygons = self._measured(nodes)
        within = self._rest_areas[:, None] * _FRACTIONS[1:] ** 2
        within *= np.maximum(polygons, 0.0) / self._rest_polygons
        # Between two rings the profile falls evenly with the area at rest.
        profile = 1.0 - 0.5 * (_FRACTIONS[1:] ** 2 + _FRACTIONS[:-1] ** 2)
        between = np.maximum(np.diff(within, axis=1, prepend=0.0), 0.0)
        return DeformedLumen(tangents, within[:, -1], between @ profile)

    def _measured(
        self, nodes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Measure tangents (S, 3), and areas (S, rings) m² of the polygons across them."""
        stations = len(self._rest_areas)
        tangents, polygons = np.empty((stations, 3)), np.empty((stations, _RINGS))
        moved = np.ascontiguousarray(nodes, dtype=np.float64) - self._rest_nodes
        _measure(self._points, self._nodes, self._weights, moved, tangents, polygons)
        return tangents, polygons


@njit(cache=True, nogil=True, error_model="numpy")
def _measure(points, nodes, weights, moved, tangents, polygons):
    """Fill tangents (S, 3) and polygons (S, rings).

    Shapes and units:
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


def load_lumen_map(volume: Volume, label: int) -> tuple[Lumen, LumenMap]:
    """Load or measure the lumen of a label, and the map of the voxels around it."""
    assert volume.labels is not None
    inside = volume.labels == label
    about = hashlib.sha256(np.packbits(inside))
    about.update(repr((_WAY, inside.shape, volume.index_to_patient.tolist())).encode())

    def make() -> tuple[Lumen, LumenMap]:
        lumen = measure_lumen(inside, volume.index_to_patient)
        return lumen, _map(lumen, inside, volume.index_to_patient)

    return load_or_create(f"lumen-{about.hexdigest()[:16]}", _pack, _unpack, make)


def _map(lumen: Lumen, inside: NDArray[np.bool_], to_patient: NDArray[np.float64]) -> LumenMap:
    voxels = np.argwhere(inside)
    low, high = voxels.min(axis=0) - _MARGIN, voxels.max(axis=0) + _MARGIN + 1
    shape = tuple(high - low)
    index = np.indices(shape).reshape(3, -1).T + low
    station, offset = lumen.locate_points(index @ to_patient[:3, :3].T + to_patient[:3, 3])
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


_ALONG = 0.25  # least cosine between the direction that is set and the vessel's own


class Vessel:
    """A vessel of a volume, and the blood in it, at stations evenly spaced along it.

    At a place of the tissue the velocity is that on the axis at the nearest station, times 1 less
    the square of the radial coordinate there at rest, which `map` knows.

    Args:
        volume: in frame ``patient``, with labels.
        label: of the vessel's lumen.

    Raises:
        SceneError: the label is no tube, or the flow's direction is across it.
    """

    def __init__(self, name: str, volume: Volume, label: int, settings: FlowSettings) -> None:
        self.name = name
        try:
            lumen, self.map = load_lumen_map(volume, label)
        except VolumeError as error:
            raise SceneError(f"{name}.flow: the structure {error}: a flow needs a tube") from error
        self._plain = lumen
        self._mesh: TetrahedralMesh | None = None
        self._carried = CarriedLumen(lumen, None)
        self._now = self._carried.rest
        self._circulation: Circulation | None = None
        self.apply_settings(settings)

    @property
    def areas(self) -> NDArray[np.float64]:
        """(S,) m², of the lumen across the vessel, at its stations in the direction of the flow."""
        return self._now.areas

    def find_flow_sign(self, settings: FlowSettings) -> float:
        """Return 1 if blood flows from the first station to the last, -1 for the other way.

        Raises:
            SceneError: the direction is across the vessel.
        """
        lumen = self._plain
        along = lumen.centres[-1] - lumen.centres[0]
        wanted = np.array(settings.direction)
        cosine = float(along @ wanted) / float(np.linalg.norm(along) * np.linalg.norm(wanted))
        if abs(cosine) < _ALONG:
            x, y, z = along / np.linalg.norm(along)
            raise SceneError(
                f"{self.name}.flow.direction: {wanted.tolist()} is across the vessel, which runs "
                f"along ({x:.2f}, {y:.2f}, {z:.2f}) or against that: give one of the two"
            )
        return 1.0 if cosine > 0.0 else -1.0

    def apply_settings(self, settings: FlowSettings) -> None:
        """Apply other settings from now on; blood that has filled up stays."""
        self._sign = self.find_flow_sign(settings)
        self.settings = settings
        self._waveform = Waveform(settings)
        lumen = self._plain
        self._circulation = Circulation(settings, lumen.areas, lumen.spacing, self._circulation)
        #: m³/s along the vessel at the time of the latest `advance_to`, averaged over the pulse.
        self.flow = self._circulation.at_rest
        self._find_axis_velocity()

    def attach_mesh(self, mesh: TetrahedralMesh | None) -> None:
        """Let this mesh carry the vessel from now on; None lets it stay as it is."""
        self._mesh = mesh
        self._carried = CarriedLumen(self._plain, mesh)
        self._now = self._carried.rest
        self._find_axis_velocity()

    def advance_to(self, time: float, nodes: NDArray[np.float64] | None) -> None:
        """Advance to a time (s), with the mesh's nodes (N, 3) m there; None: without tissue."""
        self._now = self._carried.rest
        if nodes is not None and self._mesh is not None:
            self._now = self._carried.deform_lumen(nodes)
        assert self._circulation is not None
        self.flow = self._circulation.compute_flow(time, self._now.areas)
        self._find_axis_velocity()

    def evaluate_pulse(self, time: ArrayLike) -> NDArray[np.float64]:
        """Return the flow over its average over the pulse, at times (any shape) s."""
        return self._waveform(time)

    def _find_axis_velocity(self) -> None:
        """Find the velocity (S, 3) m/s on the axis that makes the flow the same at all stations."""
        filled = np.maximum(self._now.filled, 1e-12)
        speed = np.where(self._now.filled > 1e-12, self._sign * self.flow / filled, 0.0)
        #: (S, 3) m/s, on the axis at each station, averaged over the pulse.
        self.axis_velocity = speed[:, None] * self._now.tangents


VISCOSITY = 3.5e-3
"""Pa s, of blood where it is sheared fast (W. W. Nichols, M. F. O'Rourke, McDonald's Blood Flow in
Arteries, 5th ed., 2005, chapter 2: 3 to 4)."""

_SHUT = 1e-3
"""Open fraction of a lumen below which it is shut: its resistance is a million times that at rest,
and what is left of the flow not to be seen."""


class Circulation:
    """Flow along a vessel as its lumen narrows and opens, averaged over the pulse: a Windkessel.

        q = p / (D + R),    T dp/dt = (P - p) - S q

    Blood comes from capillaries at pressure P through a resistance S into an elastic reservoir at
    pressure p, and flows on through the vessel's own resistance R, and D downstream (N. Westerhof,
    J.-W. Lankhaar, B. E. Westerhof, Med. Biol. Eng. Comput. 47, 2009). R is Poiseuille's, the sum
    of 8 π μ ds / a² of the open area a; T is the time constant of filling. An artery has p = P.
    Inertia and turbulence are left out. A vessel is closed at 0.27 of its area at rest, as elastic
    tubes are (Flaherty, Keller, Rubinow, SIAM J. Appl. Math. 23, 1972).

    Args:
        rest_areas: (S,) m², of the lumen at rest, at places evenly spaced along it.
        spacing: m, between them.
        before: the same vessel with other settings, whose reservoir this one takes over.
    """

    def __init__(
        self,
        settings: FlowSettings,
        rest_areas: NDArray[np.float64],
        spacing: float,
        before: Circulation | None = None,
    ) -> None:
        self._closed_at = settings.closed_at
        self._rest_areas = rest_areas
        self._resistances = 8 * math.pi * VISCOSITY * spacing / rest_areas**2
        self.at_rest = settings.mean_velocity * float(rest_areas.mean())
        """m³/s, mean flow with the tissue at rest."""
        self._rest_pressure = settings.pressure_at_rest
        # A vessel longer or narrower than its pressure drives blood through has all the resistance.
        whole = self._rest_pressure / self.at_rest
        own = min(1.0, 0.9 * whole / float(self._resistances.sum()))
        self._resistances *= own
        self._downstream = whole - float(self._resistances.sum())
        self._reservoir = settings.kind == "venous"
        self._source = settings.bed_pressure if self._reservoir else self._rest_pressure
        self._bed = (self._source - self._rest_pressure) / self.at_rest
        self._filling_time = settings.filling_time
        self.pressure = self._rest_pressure  # Pa, in the reservoir before the vessel
        self._time: float | None = None
        if before is not None and before._reservoir and self._reservoir:
            self.pressure, self._time = min(before.pressure, self._source), before._time

    def compute_flow(self, time: float, areas: NDArray[np.float64]) -> float:
        """Return m³/s averaged over the pulse, at a time (s), with areas (S,) m² since the last.

        Where time goes back, as when a recording begins again, the reservoir is as at rest.
        """
        closed_at = self._closed_at
        open_ = np.maximum(areas / self._rest_areas - closed_at, 0.0) / (1.0 - closed_at)
        conductance = 0.0
        if open_.min() > _SHUT:
            vessel = float((self._resistances / open_**2).sum())
            conductance = 1.0 / (self._downstream + vessel)
        if self._time is None or time < self._time:
            self.pressure = self._rest_pressure
        elif self._reservoir:
            # The equation is linear: between two frames its solution is exact.
            rate = 1.0 + self._bed * conductance
            settled = self._source / rate
            left = math.exp(-rate * (time - self._time) / self._filling_time)
            self.pressure = settled + (self.pressure - settled) * left
        self._time = time
        return conductance * self.pressure


_BELLS = ((0.13, 0.045, 1.0), (0.33, 0.06, -0.32), (0.52, 0.09, 0.10))
"""Middle and standard deviation, in beats, and height of the arterial pulse's three waves."""

_CARDIAC = 0.25  # fraction of the swing of a vein's flow that is the heart's; the rest is breathing
_FINE = 4096  # places at which the pulse's shape is measured


class Waveform:
    """Flow over its mean, as a function of time; its mean over a beat and a breath is 1.

    An artery of a limb at rest has a triphasic pulse (McDicken and Hoskins, in Hoskins, Martin and
    Thrush, Diagnostic Ultrasound: Physics and Equipment, 2nd ed., 2010, chapter 9): three bells,
    scaled to the peak and mean that are set. Flow in a vein swings with breathing, and a little
    with the heart (Baekgaard and Strandberg, Phlebolymphology, 2016).
    """

    def __init__(self, settings: FlowSettings) -> None:
        self._heart, self._breath = settings.heart_rate, settings.respiration_rate
        # A parabolic profile is twice as fast on the axis as in its mean.
        peak = 0.5 * settings.peak_velocity / settings.mean_velocity
        self._is_arterial = settings.kind == "arterial"
        self._swing, self._base = peak - 1.0, 1.0
        if self._is_arterial:
            shape = _triphasic(np.arange(_FINE) / _FINE)
            mean, highest = float(shape.mean()), float(shape.max())
            self._swing = (peak - 1.0) / (highest - mean)
            self._base = 1.0 - self._swing * mean

    def __call__(self, time: ArrayLike) -> NDArray[np.float64]:
        """Return flow over its mean at times (any shape) s; beat and breath begin at 0."""
        seconds = np.asarray(time, dtype=np.float64)
        beat = np.mod(seconds * self._heart, 1.0)
        if self._is_arterial:
            return np.asarray(self._base + self._swing * _triphasic(beat))
        swing = _CARDIAC * np.cos(2 * np.pi * beat)
        swing += (1.0 - _CARDIAC) * np.cos(2 * np.pi * np.mod(seconds * self._breath, 1.0))
        return np.asarray(self._base + self._swing * swing)


def _triphasic(beat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the arterial pulse's shape at fractions of a beat, 0 to 1; its peak is about 1."""
    shape = np.zeros_like(beat)
    for middle, width, height in _BELLS:
        apart = np.mod(beat - middle + 0.5, 1.0) - 0.5  # the bell of the beat before, or after
        shape += height * np.exp(-0.5 * (apart / width) ** 2)
    return shape
