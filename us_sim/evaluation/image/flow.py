"""Flow: the rate through a plane, a closed vein, and its cost."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.image.measure import PROBES, row_of, time_row, voxel_grid
from us_sim.evaluation.timing import medians_in_turn
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.flow.blood import Blood, Window
from us_sim.slicing.flow.doppler import ColourDoppler
from us_sim.slicing.flow.vessel import Vessel
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.beams import beam_angles, fractions_and_depths
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import ColourSettings, FlowSettings
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

Row: TypeAlias = "dict[str, Any]"

_SYSTOLE = 0.13 / 1.1  # s after the beat begins


def flow_rows(quick: bool) -> Iterator[Row]:
    """A vessel of known radius, at rest and pressed by a known amount."""
    for name, probe in PROBES.items():
        scan = TubeScan(probe)
        for degrees in (10.0, 30.0) if quick else (5.0, 10.0, 20.0, 30.0, 40.0):
            yield from _rates(scan, name, degrees)
        if name == "linear":
            yield _closed(scan)
            yield from _costs(scan, 20 if quick else 200)


def _rates(scan: TubeScan, name: str, degrees: float) -> Iterator[Row]:
    """The rate through the plane, at rest and pressed, at two moments of the pulse."""
    for state, fraction in (("rest", 1.0), ("pressed", 0.6)):  # heights of the lumen
        nodes = squeezed(scan.rest, fraction)
        for moment in (0.0, _SYSTOLE):
            frame = scan.frame(degrees, nodes, moment)
            rates = (1e6 * scan.expected_rate(moment), 1e6 * scan.rate(frame))
            yield row_of(f"flow_rate_{state}", name, degrees, DEPTH, *rates, "ml/s")


def _closed(scan: TubeScan) -> Row:
    """The fastest velocity in a vessel that is pressed flat."""
    frame = scan.frame(30.0, squeezed(scan.rest, 0.2), 3.0)
    fastest = scan.fastest(frame)
    scan.blood.at(scan.frame(30.0, scan.rest, 4.0))
    return row_of("flow_closed", "linear", 30.0, DEPTH, 0.0, fastest, "m/s")


def _costs(scan: TubeScan, count: int) -> Iterator[Row]:
    """Processor time of an image, and of one with colour in a quarter of it."""
    frame = scan.frame(20.0, scan.rest, 0.0)
    doppler = ColourDoppler(frame.probe, dataclasses.replace(ColourSettings(), width=0.5))

    def with_colour(moment: float) -> None:
        made = scan.frame(20.0, scan.rest, moment)
        _ = made.pixels
        doppler.estimate(scan.blood, made)

    ways: dict[str, Callable[[float], object]] = {
        "off": lambda moment: scan.frame(20.0, scan.rest, moment).pixels,
        "on": with_colour,
    }
    medians = medians_in_turn(ways, count + 5, 5, prepare=lambda k: 0.01 * k)
    for name, ms in medians.items():
        yield time_row(f"flow_cost_{name}", ms, 20.0)


_SIDES = (24e-3, 80e-3, 40e-3)  # m, of the block
RADIUS, DEPTH = 3e-3, 20e-3  # m, of the vessel, and of its axis, which runs along y

FLOW = FlowSettings(
    "arterial", (0.0, 1.0, 0.0), peak_velocity=0.8, mean_velocity=0.1, pressure=40e3
)
"""So much pressure that a press that does not close it changes its flow by a thousandth."""


def squeezed(nodes: NDArray[np.float64], fraction: float) -> NDArray[np.float64]:
    """Nodes (N, 3) m with the vessel pressed flat to that fraction, its axis staying."""
    pressed = nodes.copy()
    pressed[:, 2] = DEPTH + (pressed[:, 2] - DEPTH) * fraction
    return pressed


class TubeScan:
    """Frames of one probe across the vessel."""

    def __init__(self, probe: Probe) -> None:
        volume, self._vessel = _vessel()
        # 34,992 tetrahedra around the vessel.
        x, y = (uniform_planes(-0.5 * side, 0.5 * side, 19) for side in _SIDES[:2])
        mesh = box_mesh(x, y, uniform_planes(0.0, _SIDES[2], 19))
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

    def fastest(self, frame: Frame) -> float:
        """m/s along the beam where that is greatest."""
        return float(np.nanmax(np.abs(self._seen(frame)[0])))

    def expected_rate(self, time: float) -> float:
        """m³/s, Poiseuille's with the settings' mean velocity, at that moment of the pulse."""
        return FLOW.mean_velocity * math.pi * RADIUS**2 * self.pulse(time)

    def pulse(self, time: float) -> float:
        """Flow over its mean over a beat."""
        return float(self._vessel.pulse(time))

    def _seen(self, frame: Frame) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Velocity along each beam towards the probe, and its cosine with a flow along y."""
        rotation = frame.pose.rotation
        along_y = np.sin(self._angles) * rotation[1, 0] + np.cos(self._angles) * rotation[1, 2]
        return self.blood.velocity(frame, self._beams), -along_y


@cache
def _vessel() -> tuple[Volume, Vessel]:
    """The block and its vessel."""
    (x, y, z), voxel = _SIDES, 2.5e-4
    extent = ((-0.5 * x, 0.5 * x), (-0.5 * y, 0.5 * y), (0.0, z))
    counts, to_patient = voxel_grid(extent, 3 * [voxel])
    across, down = (to_patient[a, 3] + voxel * np.arange(counts[a]) for a in (0, 2))
    section = np.hypot(across[:, None], down - DEPTH) < RADIUS
    labels = np.repeat(section[:, None], counts[1], axis=1).astype(np.uint8)
    volume = Volume(np.full(counts, 90, np.uint8), to_patient, labels, {1: "vessel"})
    return volume, Vessel("vessel", volume, 1, FLOW)
