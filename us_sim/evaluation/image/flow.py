"""Flow: the rate through a plane, the angle to the beam, aliasing, a closed vein, and its cost.

A straight vessel of known radius in a block, and the flow through an image's plane across it.

The arm's vessels in colour at a light touch, pressed and let go, and their spectra.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.image.measure import PROBES, Artefact, Point
from us_sim.evaluation.report import ReportFolder, Target, key_beside, new_figure, plain, save
from us_sim.geometry.pose import Pose
from us_sim.scene.building import blood_of, colour_of, scanner_of, tissue_model_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.drawing.annotation import Annotation
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.flow.blood import Blood, Window
from us_sim.slicing.flow.doppler import ColourDoppler, Spectrum
from us_sim.slicing.flow.vessel import Vessel
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.beams import beam_angles, fractions_and_depths
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import ColourSettings, FlowSettings
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes
from us_sim.tissue.solvers.solver import create_solver
from us_sim.volume.volume import Volume

_TILTS = (5.0, 10.0, 20.0, 30.0, 40.0)  # degrees
_SQUEEZED = (1.0, 0.6)  # heights of the lumen over that at rest
_TIMES = {"diastole": 0.0, "systole": 0.13 / 1.1}  # s after the beat begins
_NYQUIST = (0.12, 0.25, 0.5)  # m/s
_RATE_LIMIT, _ANGLE_LIMIT = 3.0, 3.0  # percent
_COST_LIMIT = 3.3  # 3 ms where an image takes 0.9


class Flow(Artefact):
    """A vessel of known radius, pressed by a known amount, and the arm's under the probe."""

    name = "flow"
    title = "Flow"
    simplified = (
        "the profile is a parabola, without what inertia makes of it (Womersley); vessels do not "
        "widen with the pulse, and what a press squeezes out of them is not seen; a stenosis loses "
        "pressure by friction alone, without a jet or turbulence behind it; colour is estimated "
        "from a phase that is known and noise that is drawn, not from echoes of single cells; the "
        "gate of pulsed-wave Doppler has no thickness across the image."
    )

    def points(self, quick: bool) -> list[Point]:
        found = []
        for name, probe in PROBES.items():
            scan = TubeScan(probe)
            for degrees in (10.0, 30.0) if quick else _TILTS:
                found += _rates(scan, name, degrees)
                found.append(_angle(scan, name, degrees))
            if name == "linear":
                found += _aliasing(scan, 3 if quick else 24)
                found.append(_closed(scan))
                found += _costs(scan, 20 if quick else 200)
        return found

    def targets(self, points: Sequence[Point]) -> list[Target]:
        worst = {
            what: max(abs(p.error_percent) for p in points if p.artefact.startswith(what))
            for what in ("flow_rate", "flow_angle")
        }
        (closed,) = (p for p in points if p.artefact == "flow_closed")
        plain_ms, colour_ms = _milliseconds(points)
        rate = "flow through a plane across the vessel, three probes, tilted 5° to 40°"
        return [
            Target.at_most(rate, _RATE_LIMIT, worst["flow_rate"], "%"),
            Target.at_most("velocity by the cosine", _ANGLE_LIMIT, worst["flow_angle"], "%"),
            Target.at_most("velocity in a vein that is pressed flat", 0, closed.measured, "m/s"),
            Target.at_most(
                "image with colour in a quarter of it, over one without",
                _COST_LIMIT,
                colour_ms / plain_ms,
            ),
        ]

    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:

        figure = new_figure(12.0, 3.8, "Flow: rate through a plane, and aliasing of its colours")
        rates, aliased = figure.subplots(1, 2)
        for name in PROBES:
            for state in ("rest", "pressed"):
                mine = [p for p in points if p.artefact == f"flow_rate_{state}"]
                mine = [p for p in mine if p.probe == name]
                label = f"{name}, {'at rest' if state == 'rest' else 'pressed'}"
                rates.plot([p.tilt_deg for p in mine], [p.error_percent for p in mine], ".",
                           label=label)  # fmt: skip
        rates.set(xlabel="tilt, degrees", ylabel="error of the rate, %", ylim=(-4, 4))
        key_beside(rates)
        for nyquist in _NYQUIST:
            name = f"flow_aliasing_{100 * nyquist:g}cm/s"
            shown = [p for p in points if p.artefact == name]
            label = f"Nyquist velocity {100 * nyquist:g} cm/s"
            aliased.plot([100 * p.expected for p in shown], [100 * p.measured for p in shown], ".",
                         label=label)  # fmt: skip
        aliased.set(xlabel="true velocity on the axis, folded, cm/s", ylabel="shown, cm/s")
        key_beside(aliased)
        for panel in (rates, aliased):
            plain(panel)
        save(figure, folder.picture("flow_rate"))
        draw_arm(folder.picture("flow"))
        plain_ms, colour_ms = _milliseconds(points)
        return [
            "![The arm's vessels in colour](image_flow.png)",
            "The arm, scanned across its vessels by a probe that is tilted by 20° along them: at a "
            "light touch, under a full press, and let go again; all at systole. The artery keeps "
            "its flow, the vein has none while it is closed, and more than before afterwards. "
            "Below: the spectrum at a gate in each of them, from the touch until after the press.",
            "![Flow through a plane, and aliasing](image_flow_rate.png)",
            f"A vessel of {1e3 * DEPTH:g} mm depth in a block, at rest and pressed to 60 % of its "
            "height. The rate is the sum of `ultrasound/velocity` over the pixels of the image, "
            "divided by the cosine of the angle between each beam and the vessel; expected is "
            "Poiseuille's. On the right is the colour on the axis over a beat, 40 cm/s along the "
            "beam at most: beyond the Nyquist velocity it turns over.",
            f"An image of 512 × 512 takes {plain_ms:.2f} ms of one core, and with colour in a "
            f"quarter of it {colour_ms:.2f} ms, {colour_ms / plain_ms:.1f} times as long.",
        ]


def _milliseconds(points: Sequence[Point]) -> tuple[float, float]:
    """Of an image, and of one with colour."""
    off, on = (
        next(p.ms_median for p in points if p.artefact == f"flow_cost_{what}")
        for what in ("off", "on")
    )
    return off, on


def _rates(scan: TubeScan, name: str, degrees: float) -> list[Point]:
    """The rate through the plane, at rest and pressed, at two moments of the pulse."""
    found = []
    for fraction in _SQUEEZED:
        nodes = squeezed(scan.rest, fraction)
        state = "rest" if fraction == 1.0 else "pressed"
        for moment in _TIMES.values():
            frame = scan.frame(degrees, nodes, moment)
            rates = (1e6 * scan.expected_rate(moment), 1e6 * scan.rate(frame))
            found.append(Point.of(f"flow_rate_{state}", name, degrees, DEPTH, *rates, "ml/s"))
    return found


def _angle(scan: TubeScan, name: str, degrees: float) -> Point:
    """The fastest velocity along a beam, which is that of the axis times a cosine."""
    frame = scan.frame(degrees, scan.rest, _TIMES["systole"])
    measured, cosine = scan.fastest(frame)
    axis = 2.0 * FLOW.mean_velocity * scan.pulse(_TIMES["systole"])
    return Point.of("flow_angle", name, degrees, DEPTH, axis * cosine, measured, "m/s")


def _aliasing(scan: TubeScan, moments: int) -> list[Point]:
    """What is shown of the axis over a beat; errors are of twice the Nyquist velocity."""
    found = []
    for nyquist in _NYQUIST:
        settings = ColourSettings(
            depth=DEPTH, nyquist_velocity=nyquist, persistence=0.0, resolution=0.0, pulses=64
        )
        doppler = ColourDoppler(PROBES["linear"], settings)
        for k in range(moments):
            moment = _TIMES["systole"] + k / (moments * FLOW.heart_rate)
            frame = scan.frame(30.0, scan.rest, moment)
            truth, shown = (make(scan.blood, frame) for make in (doppler.truth, doppler.estimate))
            core = np.abs(truth) > 0.99 * np.nanmax(np.abs(truth))  # around the axis
            if np.isnan(shown[core]).any():
                continue  # the wall filter takes what is as slow as tissue, or seems so
            expected, seen = (
                nyquist / np.pi * float(np.angle(np.exp(1j * np.pi * each / nyquist).mean()))
                for each in (truth[core].astype(float), shown[core].astype(float))
            )
            name, whole = f"flow_aliasing_{100 * nyquist:g}cm/s", 2.0 * nyquist
            row = (name, "linear", 30.0, DEPTH, expected, seen, "m/s")
            found.append(Point.of(*row, of=whole))
    return found


def _closed(scan: TubeScan) -> Point:
    """The fastest velocity in a vessel that is pressed flat."""
    frame = scan.frame(30.0, squeezed(scan.rest, 0.2), 3.0)
    fastest = abs(scan.fastest(frame)[0])
    scan.blood.at(scan.frame(30.0, scan.rest, 4.0))
    return Point.of("flow_closed", "linear", 30.0, DEPTH, 0.0, fastest, "m/s")


def _costs(scan: TubeScan, count: int) -> list[Point]:
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
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for k in range(count + 5):
        for name, work in ways.items():  # in turn, as the machine's speed changes
            began = time.thread_time()
            work(0.01 * k)
            taken[name].append(1e3 * (time.thread_time() - began))
    nan = float("nan")
    return [
        Point(f"flow_cost_{name}", "linear", 20.0, nan, ms_median=float(np.median(each[5:])))
        for name, each in taken.items()
    ]


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


_TILT = math.radians(20)
_AIM = 15e-3  # m, depth at which the middle beam crosses the plane under the probe's middle
_TOUCH, _PRESS = 3e-3, 12e-3  # m
_PER_BEAT = 14  # poses
_HEIGHT = np.array([[0.0, _TOUCH], [2.5, _TOUCH], [4.0, _PRESS], [6.0, _PRESS], [6.6, _TOUCH],
                    [9.0, _TOUCH]])  # fmt: skip
"""Time, s, and depth of the probe, m."""
_SHOWN = {"light touch": 2, "full press": 6, "let go": 8}
"""Beats whose systole is shown."""
_SYSTOLE = 0.13  # of a beat
_GATES = {"artery": (-0.15, 11.5e-3, 0.3, 0.6), "vein": (0.05, 10e-3, 0.08, -0.6)}
"""Beam, depth in m, Nyquist velocity in m/s and baseline; gates are long, as vessels go down."""


def draw_arm(file: Path) -> None:
    """Draw the picture."""
    scene = load_scene("upper_arm")
    volume = volume_of(scene)
    blood = blood_of(scene, volume)
    scanner = scanner_of(scene, volume)
    probe = scanner.probe
    colour = ColourDoppler(probe, dataclasses.replace(scene.colour, persistence=0.0))
    spectra = {}
    for name, (lateral, depth, nyquist, baseline) in _GATES.items():
        gate = dataclasses.replace(
            scene.spectrum,
            lateral=lateral,
            depth=depth,
            size=8e-3,
            nyquist_velocity=nyquist,
            baseline=baseline,
            angle_correction=math.pi / 2 - _TILT,
            sweep=8.0,
        )
        spectra[name] = Spectrum(probe, gate)
    numbers = {name: number for number, name in volume.label_names.items()}
    outlined = {numbers[name]: (name, colour_of(scene, name)) for name in _GATES}
    annotation = Annotation(probe, outlined)
    model = tissue_model_of(scene, volume)
    scanner.carry(model.mesh.nodes, model.mesh.tetrahedra)
    solver = create_solver("fem_nonlinear", model)
    pictures: dict[str, NDArray[np.uint8]] = {}
    beat = 1.0 / scene.flows["artery"].heart_rate
    shown = {round((count + _SYSTOLE) * beat, 6): title for title, count in _SHOWN.items()}
    for moment, pose in _poses(beat):
        nodes = solver.deform(pose).nodes
        frame = scanner.frame(pose, nodes, time=moment)
        sweeps = {name: spectrum.show(blood, frame) for name, spectrum in spectra.items()}
        if round(moment, 6) in shown:
            pictures[shown[round(moment, 6)]] = _picture(frame, blood, colour, annotation)
    _draw(pictures, sweeps, file)


def _poses(beat: float) -> Iterator[tuple[float, Pose]]:
    """Times, s, and poses of a probe that is tilted along the vessels and pressed along itself."""
    turn = np.array([math.sin(0.5 * _TILT), 0.0, 0.0, math.cos(0.5 * _TILT)])
    along = Pose(np.zeros(3), turn).rotation[:, 2]
    start = np.array([0.0, 0.0, _AIM]) - along * (_AIM / along[2])
    count = int(_HEIGHT[-1, 0] / beat * _PER_BEAT)
    for moment in (_SYSTOLE + np.arange(count) / _PER_BEAT) * beat:
        depth = float(np.interp(moment, *_HEIGHT.T))
        yield float(moment), Pose(start + along * depth, turn)


def _picture(
    frame: Frame, blood: Blood, colour: ColourDoppler, annotation: Annotation
) -> NDArray[np.uint8]:
    """The image with its colours."""
    velocity = colour.estimate(blood, frame)
    overlay = Overlay(velocity, colour.scale, 0.9, outline=colour.outline)
    return annotation.draw(frame.pixels, frame.labels, overlay=overlay)


def _draw(
    pictures: dict[str, NDArray[np.uint8]], sweeps: dict[str, NDArray[np.uint8]], file: Path
) -> None:
    figure = new_figure(12.0, 6.9, "The arm's artery and vein under a probe tilted along them")
    grid = figure.add_gridspec(2, 6, height_ratios=[2.0, 1.0])
    panels = [figure.add_subplot(grid[0, 2 * i : 2 * i + 2]) for i in range(3)]
    panels += [figure.add_subplot(grid[1, 3 * i : 3 * i + 3]) for i in range(2)]
    named = {**pictures, **{f"spectrum in the {name}": each for name, each in sweeps.items()}}
    for panel, (title, picture) in zip(panels, named.items(), strict=True):
        panel.imshow(picture)
        panel.set_title(title, fontsize=10)
        panel.axis("off")
    save(figure, file)
