"""A vessel with its flow: how fast blood flows along it as the tissue has it now.

>>> import numpy as np
>>> from us_sim.slicing.flow.settings import FlowSettings
>>> from us_sim.slicing.flow.vessel import Vessel
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

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import SceneError, VolumeError
from us_sim.slicing.flow.carried_lumen import CarriedLumen
from us_sim.slicing.flow.circulation import Circulation
from us_sim.slicing.flow.lumen_map import mapped_lumen
from us_sim.slicing.flow.settings import FlowSettings
from us_sim.slicing.flow.waveform import Waveform
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.volume.volume import Volume

_ALONG = 0.25
"""Least cosine between the direction that is set and the vessel's own."""


class Vessel:
    """A vessel of a volume, and the blood in it, at stations evenly spaced along it.

    At a place of the tissue the velocity is that on the axis at the nearest station, times 1 less
    the square of the radial coordinate there at rest, which `map` knows.

    Args:
        name: of it, for sentences.
        volume: in frame ``patient``, with labels.
        label: of the vessel's lumen.
        settings: of the flow.

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
