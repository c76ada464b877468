"""Strain along the beams: of a block under a plate, of a stiff ball, and as an estimate has it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.block import EXTENT, MESHES, block
from us_sim.evaluation.figure import new_figure, save
from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.inclusion import Ball, Reference, ball_mesh, ball_nodes, labelled
from us_sim.evaluation.image.layers import tilted
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.image.pressed_block import (
    PRESS,
    beam_displacement,
    beam_strain,
    pressed_block,
)
from us_sim.evaluation.image.strain_estimates import compared_ball
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.slice.cases import MAIN
from us_sim.evaluation.slice.cases import speckle as block_volume
from us_sim.evaluation.target import Target
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.drawing.annotation import Annotation
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.slicing.strain import AxialStrain, displacement, strain_scale
from us_sim.volume.volume import Volume

PROBES: dict[str, Probe] = {
    "linear": LinearProbe(aperture=0.06, depth=0.08),
    "convex": ConvexProbe(radius=0.04, opening_angle=np.radians(60), depth=0.08),
    "sector": SectorProbe(aperture=0.02, opening_angle=np.radians(90), depth=0.08),
}
_TILTS = (0.0, 10.0, 20.0, 30.0, 40.0)
_BALLS = {"ball_1.8": Ball(stiffer=1.8), "ball_3.2": Ball(stiffer=3.2)}
"""As stiff as the third and fourth kind of lesion of the phantom CIRS 049 (45 and 80 in 25 kPa)."""
_SHOWN = "ball_3.2"
_PRESS = 0.002  # m, of 100
_FINE, _COARSE = 3e-3, 6e-3  # m, between the reference's planes around a ball
_BLOCK_LIMIT, _BALL_LIMIT, _RATIO = 2.0, 5.0, 2.0 / 0.9
_IMAGES, _QUICK_IMAGES = 80, 20


class StrainImages(Artefact):
    """Against closed forms, a fine mesh, and the estimate against the strain itself."""

    name = "strain"
    title = "Strain"
    simplified = (
        "strain is as exact as the tissue's mesh, averaged at its nodes; the estimate tracks grey "
        "values along the beams alone, where scanners track radio-frequency echoes, and speckle is "
        "carried by the tissue without decorrelation."
    )

    def points(self, quick: bool) -> list[Point]:
        found = []
        for name, probe in PROBES.items():
            for degrees in (0.0, 40.0) if quick else _TILTS:
                found += _block_rows(name, probe, degrees, MESHES[0 if quick else -1])
        for name in [*_BALLS][: 1 if quick else None]:
            found += _ball_rows(name, _BALLS[name], _COARSE if quick else _FINE)
        found += compared_ball(_BALLS["ball_1.8" if quick else _SHOWN])
        return found + _time_rows(quick)

    def targets(self, points: Sequence[Point]) -> list[Target]:
        targets = []
        for artefact, what in (("strain_block", "strain"), ("displacement_block", "displacement")):
            worst = max(abs(p.error_percent) for p in points if p.artefact == artefact)
            what += " of a homogeneous block under a plate, worst pixel, every probe"
            targets.append(Target.at_most(what, _BLOCK_LIMIT, worst, "%"))
        for point in points:
            if point.artefact.endswith("_sharp"):
                what = f"mean strain in a {point.artefact.split('_')[2]} times as stiff ball"
                error = abs(point.error_percent)
                targets.append(Target.at_most(f"{what}, borders sharp", _BALL_LIMIT, error, "%"))
        plain, strained = (_ms(points, name) for name in ("strain_none", "strain_image"))
        what = "slice with strain, over the plain slice (2 ms over 0.9 ms are asked)"
        return [*targets, Target.at_most(what, round(_RATIO, 2), strained / plain)]

    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:
        _draw(folder)
        block_error = max(abs(p.error_percent) for p in points if p.artefact == "strain_block")
        parts = [
            "![The ball as B-mode, its strain, and the estimate](image_strain.png)",
            f"A block that a plate presses by {100 * PRESS:g} % of its height is strained alike "
            f"everywhere if its Poisson's ratio is 0; `fem` presses it. Each row is the pixel with "
            f"the greatest error, in strain {block_error:.2g} % of the press at most.",
        ]
        for point in points:
            if point.artefact.startswith("strain_ball"):
                parts.append(
                    f"`{point.artefact}`: {100 * point.measured:.3f} % on average, "
                    f"{100 * point.expected:.3f} % in the reference ({point.error_percent:+.1f} %)."
                )
        parts.append(
            "The reference is Hooke's law on quadratic tetrahedra with planes "
            f"{1e3 * _FINE:g} mm apart around the ball (scikit-fem, SciPy); the simulator's mesh "
            "has 34,875 tetrahedra. `sharp` averages nothing over the ball's border "
            "(`strain.borders`); what is left is mostly the mesh's, whose tetrahedra on the border "
            "are of a mean stiffness. `unsmoothed` is the strain of the tetrahedra themselves."
        )
        estimates = [p for p in points if p.artefact.startswith("strain_estimate")]
        parts += [
            f"`{p.artefact}`: {100 * p.measured:.3f} % where the strain is "
            f"{100 * p.expected:.3f} % ({p.error_percent:+.1f} %)."
            for p in estimates
            if not p.artefact.endswith("rms")
        ]
        parts += [
            f"`{p.artefact}`: {100 * p.measured:.3f} % of strain, {p.error_percent:.0f} % of that "
            f"applied; an estimate takes {p.ms_median:.0f} ms."
            for p in estimates
            if p.artefact.endswith("rms")
        ]
        times = {p.artefact: p.ms_median for p in points if p.artefact.startswith("strain_")}
        parts.append(
            f"An image of 512 × 512 takes {times['strain_none']:.2f} ms, with strain "
            f"{times['strain_image']:.2f} ms, with displacement {times['strain_displacement']:.2f} "
            "ms (medians, taken in turn)."
        )
        return parts


def _block_rows(
    name: str, probe: Probe, degrees: float, counts: tuple[int, int, int]
) -> list[Point]:
    """The pixels with the greatest error of strain, and of axial displacement."""
    mesh, nodes = block(counts), pressed_block(counts)
    scanner = BMode(labelled(None), probe)
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    turn = tilted(degrees)
    frame = scanner.frame(Pose(np.array([0.0, 0.0, 0.02]), turn.orientation), nodes)
    deepest = PRESS * EXTENT[2][1]
    strain, moved = AxialStrain.of(frame).image(frame), displacement(frame)[..., 1]
    rows = []
    for artefact, found, expected, unit, whole in (
        ("strain_block", strain, beam_strain(frame), "", PRESS),
        ("displacement_block", moved, beam_displacement(frame)[..., 1], "m", deepest),
    ):
        error = np.where(np.isfinite(found), np.abs(found - expected), -1.0)
        at = np.unravel_index(int(error.argmax()), error.shape)
        depth = float(probe.pixel_beams[1][at])
        row = (artefact, name, degrees, depth, float(expected[at]), float(found[at]), unit)
        rows.append(Point.of(*row, of=whole))
    return rows


def _ball_rows(name: str, ball: Ball, size: float) -> list[Point]:
    """Mean strain in the ball: smooth, sharp, and of the tetrahedra themselves."""
    frame = ball_frame(ball, labelled(ball))
    inside = frame.labels == 2
    index = frame.located.rest_index()[inside]
    to_patient = frame.volume.index_to_patient
    rest = (index @ to_patient[:3, :3].T + to_patient[:3, 3])[::23]
    gradient = np.eye(3) + _PRESS * _reference(ball, size).gradient(rest)
    along = np.linalg.inv(gradient)[:, :, 2]  # where a unit along z now was
    expected = float(np.mean(1.0 / np.linalg.norm(along, axis=1) - 1.0))
    kinds: dict[str, NDArray[Any]] = {
        "": AxialStrain.of(frame).image(frame),
        "_sharp": AxialStrain.of(frame, sharp=True).image(frame),
        "_unsmoothed": _unsmoothed(frame),
    }
    return [
        Point.of(
            f"strain_{name}{kind}", "linear", 0.0, ball.centre[2], expected,
            float(np.mean(values[inside])), "",
        )
        for kind, values in kinds.items()
    ]  # fmt: skip


@cache
def _reference(ball: Ball, size: float) -> Reference:
    return Reference(ball, size)


def ball_frame(ball: Ball, volume: Volume, press: float = _PRESS) -> Frame:
    """The ball's block under the plate, as a linear probe in the plate sees it."""
    mesh = ball_mesh(ball)
    scanner = BMode(volume, PROBES["linear"])
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    return scanner.frame(Pose(np.array([0.0, 0.0, press])), ball_nodes(ball, press))


def _unsmoothed(frame: Frame) -> NDArray[np.float64]:
    """(rows, columns) along z, of the tetrahedron that each pixel lies in."""
    assert frame.mesh is not None
    rest, tetrahedra = frame.mesh
    elements, _, numbers = frame.located
    there = (elements >= 0) & (elements < len(numbers))
    shown = tetrahedra[numbers]
    now = np.asarray(frame.nodes, dtype=np.float64)[shown]
    edges, before = now[:, 1:] - now[:, :1], rest[shown][:, 1:] - rest[shown][:, :1]
    along = np.einsum("eij,ejk->eik", np.linalg.inv(edges), before)[:, 2]
    strain = 1.0 / np.linalg.norm(along, axis=1) - 1.0
    return np.where(there, strain[np.where(there, elements, 0)], np.nan)


def _time_rows(quick: bool) -> list[Point]:
    """Processor time of one thread for an image, plain, with strain and with displacement."""
    mesh, frames = MAIN.mesh(), MAIN.frames(4)
    scanner = BMode(block_volume(), PROBES["linear"])
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    strain = AxialStrain(mesh.nodes, mesh.tetrahedra)
    work = {
        "none": lambda frame: frame.pixels,
        "image": lambda frame: (frame.pixels, strain.image(frame)),
        "displacement": lambda frame: (frame.pixels, displacement(frame)),
    }
    taken: dict[str, list[float]] = {name: [] for name in work}
    for number in range(2 + (_QUICK_IMAGES if quick else _IMAGES)):
        for name, make in work.items():
            frame = scanner.frame(Pose(np.array([0.0, 0.0, 0.012])), frames[number % 4].nodes)
            began = time.thread_time()
            make(frame)
            taken[name].append(1e3 * (time.thread_time() - began))
    return [
        Point(f"strain_{name}", "linear", 0.0, ms_median=float(np.median(each[2:])))
        for name, each in taken.items()
    ]


def _ms(points: Sequence[Point], artefact: str) -> float:
    return next(p.ms_median for p in points if p.artefact == artefact)


def _draw(folder: ReportFolder) -> None:
    """B-mode, true strain and estimate of the ball, side by side."""
    from us_sim.evaluation.image.strain_estimates import comparison

    ball = _BALLS[_SHOWN]
    frame, strain, estimate = comparison(ball)
    annotation = Annotation(frame.probe, {2: ("stiff", (0.9, 0.9, 0.9))})
    views = {"B-mode": None, "strain": strain, "estimate": estimate}
    figure = new_figure(10.0, 4.9, "A ball 3.2 times as stiff as what is around it, pressed by 1 %")
    for panel, (title, values) in zip(figure.subplots(1, 3), views.items(), strict=True):
        overlay = None
        if values is not None:
            overlay = Overlay(values, strain_scale("strain", 0.02), opacity=0.6)
        picture = annotation.draw(frame.pixels, frame.labels, overlay=overlay)
        lateral, axial = frame.probe.pixel_spacing
        panel.imshow(picture, aspect=axial / lateral)
        panel.set_title(title, fontsize=10)
        panel.set_axis_off()
    save(figure, folder.picture("strain"))
