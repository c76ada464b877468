"""The arm's vessels in colour at a light touch, pressed and let go, and their spectra."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.figure import new_figure, save
from us_sim.geometry.pose import Pose
from us_sim.scene.building import blood_of, colour_of, scanner_of, tissue_model_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.slicing.drawing.annotation import Annotation
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.colour_doppler import ColourDoppler
from us_sim.slicing.flow.spectrum import Spectrum
from us_sim.slicing.frame import Frame
from us_sim.tissue.solvers.solver import create_solver

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
    for time, pose in _poses(beat):
        nodes = solver.deform(pose).nodes
        frame = scanner.frame(pose, nodes, time=time)
        sweeps = {name: spectrum.show(blood, frame) for name, spectrum in spectra.items()}
        if round(time, 6) in shown:
            pictures[shown[round(time, 6)]] = _picture(frame, blood, colour, annotation)
    _draw(pictures, sweeps, file)


def _poses(beat: float) -> Iterator[tuple[float, Pose]]:
    """Times, s, and poses of a probe that is tilted along the vessels and pressed along itself."""
    turn = np.array([math.sin(0.5 * _TILT), 0.0, 0.0, math.cos(0.5 * _TILT)])
    along = Pose(np.zeros(3), turn).rotation[:, 2]
    start = np.array([0.0, 0.0, _AIM]) - along * (_AIM / along[2])
    count = int(_HEIGHT[-1, 0] / beat * _PER_BEAT)
    for time in (_SYSTOLE + np.arange(count) / _PER_BEAT) * beat:
        depth = float(np.interp(time, *_HEIGHT.T))
        yield float(time), Pose(start + along * depth, turn)


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
