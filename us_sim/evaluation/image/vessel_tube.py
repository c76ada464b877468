"""A straight vessel of known radius in a block, and the flow through an image's plane across it."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.flow.blood import Blood, Window
from us_sim.slicing.flow.vessel import Vessel
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.beams import beam_angles, fractions_and_depths
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import FlowSettings
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes
from us_sim.volume.volume import Volume

RADIUS, DEPTH = 3e-3, 20e-3
"""m, of the vessel, and of its axis, which runs along y."""

FLOW = FlowSettings(
    "arterial", (0.0, 1.0, 0.0), peak_velocity=0.8, mean_velocity=0.1, pressure=40e3
)
"""So much pressure that a press that does not close it changes its flow by a thousandth."""

_SIDES = (24e-3, 80e-3, 40e-3)  # m, of the block
_VOXEL = 2.5e-4
_PLANES = 19  # along each axis of the tissue, between which there are 34,992 tetrahedra


def mesh_of_block() -> TetrahedralMesh:
    """The tissue around the vessel."""
    x, y = (uniform_planes(-0.5 * side, 0.5 * side, _PLANES) for side in _SIDES[:2])
    return box_mesh(x, y, uniform_planes(0.0, _SIDES[2], _PLANES))


def squeezed(nodes: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """Nodes (N, 3) m with the vessel pressed flat to that fraction, its axis staying."""
    pressed = nodes.copy()
    pressed[:, 2] = DEPTH + (pressed[:, 2] - DEPTH) * fraction
    return pressed


class TubeScan:
    """Frames of one probe across the vessel."""

    def __init__(self, probe: Probe) -> None:
        volume, self._vessel = _vessel()
        mesh = mesh_of_block()
        self.rest = mesh.nodes
        self._scanner = BMode(volume, probe)
        self._scanner.carry(mesh.nodes, mesh.tetrahedra)
        self.blood = Blood([self._vessel])
        fraction, _ = fractions_and_depths(probe)
        self._angles = beam_angles(probe, fraction)
        self._beams = Window(probe, self._angles)

    def frame(self, degrees: float, nodes: NDArray[np.float64], time: float) -> Frame:
        """With the probe tilted along the vessel, its middle beam through the vessel's axis."""
        tilt = math.radians(degrees)
        turn = np.array([math.sin(0.5 * tilt), 0.0, 0.0, math.cos(0.5 * tilt)])
        pose = Pose(np.array([0.0, DEPTH * math.tan(tilt), 0.0]), turn)
        return self._scanner.frame(pose, nodes, time=time)

    def rate(self, frame: Frame) -> float:
        """m³/s through the image's plane, from velocities along the beams and known angles."""
        velocity, cosine = self._seen(frame)
        pixel = float(np.prod(frame.probe.pixel_spacing))
        return float(np.nansum(velocity / cosine) * frame.pose.rotation[1, 1] * pixel)

    def fastest(self, frame: Frame) -> tuple[float, float]:
        """m/s along the beam where that is greatest, and the cosine of its angle to the vessel."""
        velocity, cosine = self._seen(frame)
        place = np.nanargmax(np.abs(velocity))
        return float(velocity.flat[place]), float(cosine.flat[place])

    def expected_rate(self, time: float) -> float:
        """m³/s, Poiseuille's with the settings' mean velocity, at that moment of the pulse."""
        return FLOW.mean_velocity * math.pi * RADIUS**2 * self.pulse(time)

    def pulse(self, time: float) -> float:
        """Flow over its mean over a beat."""
        return float(self._vessel.pulse(time))

    def _seen(self, frame: Frame) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Velocity along each beam towards the probe, and the cosine with what flows along y."""
        rotation = frame.pose.rotation
        along_y = np.sin(self._angles) * rotation[1, 0] + np.cos(self._angles) * rotation[1, 2]
        return self.blood.velocity(frame, self._beams), -along_y


@cache
def _vessel() -> tuple[Volume, Vessel]:
    """The block and its vessel."""
    counts = [round(side / _VOXEL) for side in _SIDES]
    to_patient = np.diag([_VOXEL, _VOXEL, _VOXEL, 1.0])
    to_patient[:3, 3] = [0.5 * (_VOXEL - _SIDES[0]), 0.5 * (_VOXEL - _SIDES[1]), 0.5 * _VOXEL]
    x, z = (to_patient[a, 3] + _VOXEL * np.arange(counts[a]) for a in (0, 2))
    section = np.hypot(x[:, None], z - DEPTH) < RADIUS
    labels = np.repeat(section[:, None], counts[1], axis=1).astype(np.uint8)
    volume = Volume(np.full(counts, 90, np.uint8), to_patient, labels, {1: "vessel"})
    return volume, Vessel("vessel", volume, 1, FLOW)
