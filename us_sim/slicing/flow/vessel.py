"""A vessel with its flow in tissue that is pressed: circulation and pulse.

>>> import numpy as np
>>> from us_sim.slicing.flow.vessel import Vessel
>>> from us_sim.slicing.settings import FlowSettings
>>> from us_sim.volume.volume import Volume
>>> x, z = np.meshgrid(np.arange(21) - 10, np.arange(21) - 10, indexing="ij")
>>> tube = np.repeat((x**2 + z**2 < 36)[:, None], 60, axis=1).astype(np.uint8)
>>> volume = Volume(tube, np.diag([5e-4, 5e-4, 5e-4, 1.0]), tube, {1: "vein"})
>>> flow = FlowSettings("venous", (0, -1, 0), peak_velocity=0.1, mean_velocity=0.05)
>>> vein = Vessel("vein", volume, 1, flow)
>>> vein.advance(0.0, None)
>>> np.round(vein.axis_velocity[10], 2) + 0.0  # m/s, twice the mean
array([ 0. , -0.1,  0. ])
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import SceneError, VolumeError
from us_sim.slicing.flow.carried_lumen import CarriedLumen, mapped_lumen
from us_sim.slicing.settings import FlowSettings
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.volume.volume import Volume

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
            lumen, self.map = mapped_lumen(volume, label)
        except VolumeError as error:
            raise SceneError(f"{name}.flow: the structure {error}: a flow needs a tube") from error
        self._plain = lumen
        self._mesh: TetrahedralMesh | None = None
        self._carried = CarriedLumen(lumen, None)
        self._now = self._carried.rest
        self._circulation: Circulation | None = None
        self.use(settings)

    @property
    def settings(self) -> FlowSettings:
        """Of its flow."""
        return self._settings

    @property
    def flow(self) -> float:
        """m³/s along the vessel at the moment of the latest `advance`, averaged over the pulse."""
        return self._flow

    @property
    def areas(self) -> NDArray[np.float64]:
        """(S,) m², of the lumen across the vessel, at its stations in the direction of the flow."""
        return self._now.areas

    def require(self, settings: FlowSettings) -> float:
        """1 if blood flows from the first station to the last, -1 for the other way.

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

    def use(self, settings: FlowSettings) -> None:
        """Let blood flow with other settings from now on; what has filled up stays so.

        Raises:
            SceneError: as `require`.
        """
        sign = self.require(settings)
        self._settings = settings
        self._sign = sign
        self._waveform = Waveform(settings)
        lumen = self._plain
        self._circulation = Circulation(settings, lumen.areas, lumen.spacing, self._circulation)
        self._flow = self._circulation.at_rest
        self._find_axis_velocity()

    def carried_by(self, mesh: TetrahedralMesh | None) -> None:
        """Let this mesh carry the vessel from now on; None lets it stay as it is."""
        self._mesh = mesh
        self._carried = CarriedLumen(self._plain, mesh)
        self._now = self._carried.rest
        self._find_axis_velocity()

    def advance(self, time: float, nodes: NDArray[np.float64] | None) -> None:
        """Go on to a time (s), with the mesh's nodes (N, 3) m there; None: without tissue."""
        self._now = self._carried.rest
        if nodes is not None and self._mesh is not None:
            self._now = self._carried.carry(nodes)
        assert self._circulation is not None
        self._flow = self._circulation.advance(time, self._now.areas)
        self._find_axis_velocity()

    def pulse(self, time: ArrayLike) -> NDArray[np.float64]:
        """Flow over its average over the pulse, at times (any shape) s."""
        return self._waveform(time)

    def _find_axis_velocity(self) -> None:
        """Velocity (S, 3) m/s on the axis at each station, so that the flow is the same at all."""
        filled = np.maximum(self._now.filled, 1e-12)
        speed = np.where(self._now.filled > 1e-12, self._sign * self._flow / filled, 0.0)
        #: (S, 3) m/s, on the axis at each station, averaged over the pulse.
        self.axis_velocity = speed[:, None] * self._now.tangents


VISCOSITY = 3.5e-3
"""Pa s, of blood where it is sheared fast (W. W. Nichols, M. F. O'Rourke, McDonald's Blood Flow in
Arteries, 5th ed., 2005, chapter 2: 3 to 4)."""

_SHUT = 1e-3
"""Open fraction of a lumen below which it is shut: its resistance is a million times that at rest,
and what is left of the flow not to be seen."""


def open_fraction(area: NDArray[np.float64], closed_at: float) -> NDArray[np.float64]:
    """Open fraction of a lumen, from its area over that at rest and the fraction at closure."""
    return np.asarray(np.maximum(area - closed_at, 0.0) / (1.0 - closed_at))


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
        self._pressure = self._rest_pressure
        self._time: float | None = None
        if before is not None and before._reservoir and self._reservoir:
            self._pressure, self._time = min(before._pressure, self._source), before._time

    @property
    def pressure(self) -> float:
        """Pa, in the reservoir before the vessel."""
        return self._pressure

    def advance(self, time: float, areas: NDArray[np.float64]) -> float:
        """Flow averaged over the pulse, m³/s, at a time (s), with areas (S,) m² since the last.

        Where time goes back, as when a recording begins again, the reservoir is as at rest.
        """
        open_ = open_fraction(areas / self._rest_areas, self._closed_at)
        conductance = 0.0
        if open_.min() > _SHUT:
            vessel = float((self._resistances / open_**2).sum())
            conductance = 1.0 / (self._downstream + vessel)
        if self._time is None or time < self._time:
            self._pressure = self._rest_pressure
        elif self._reservoir:
            # The equation is linear: between two frames its solution is exact.
            rate = 1.0 + self._bed * conductance
            settled = self._source / rate
            left = math.exp(-rate * (time - self._time) / self._filling_time)
            self._pressure = settled + (self._pressure - settled) * left
        self._time = time
        return conductance * self._pressure


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

    Args:
        settings: of the vessel's flow.
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
        """Flow over its mean at times (any shape) s; beat and breath begin at 0."""
        seconds = np.asarray(time, dtype=np.float64)
        beat = np.mod(seconds * self._heart, 1.0)
        if self._is_arterial:
            return np.asarray(self._base + self._swing * _triphasic(beat))
        swing = _CARDIAC * np.cos(2 * np.pi * beat)
        swing += (1.0 - _CARDIAC) * np.cos(2 * np.pi * np.mod(seconds * self._breath, 1.0))
        return np.asarray(self._base + self._swing * swing)


def _triphasic(beat: NDArray[np.float64]) -> NDArray[np.float64]:
    """The arterial pulse's shape at fractions of a beat, 0 to 1; its peak is about 1."""
    shape = np.zeros_like(beat)
    for middle, width, height in _BELLS:
        apart = np.mod(beat - middle + 0.5, 1.0) - 0.5  # the bell of the beat before, or after
        shape += height * np.exp(-0.5 * (apart / width) ** 2)
    return shape
