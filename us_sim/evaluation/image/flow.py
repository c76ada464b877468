"""Flow: the rate through a plane, the angle to the beam, aliasing, a closed vein, and its cost."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence

import numpy as np

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.layers import PROBES
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.image.vessel_tube import DEPTH, FLOW, TubeScan, squeezed
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.target import Target
from us_sim.slicing.flow.doppler import ColourDoppler
from us_sim.slicing.settings import ColourSettings

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
        from us_sim.evaluation.image.flow_pictures import draw_arm

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
