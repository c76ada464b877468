"""Report of a stiffness fit: a table, a scene with the moduli, a picture of how they fit."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from us_sim.errors import StiffnessError
from us_sim.settings.spelling import aligned, counted
from us_sim.tissue.identification.press_record import CHANNELS
from us_sim.tissue.identification.stiffness import GROUPS, StiffnessFit


def table(found: StiffnessFit) -> str:
    """Structures with their moduli, intervals and part in the force, and the residuals."""
    percent = f"{100 * found.confidence:g} %"
    rows = [("structure", "E (kPa)", f"{percent} interval (kPa)", "×/÷", "part of force")]
    for name, modulus in found.moduli.items():
        unit = _unit(found, name)
        interval = found.intervals.get(name)
        if interval is None:
            rows.append((name, f"{modulus / unit:.4g}", "kept", "", ""))
            continue
        rows.append(
            (
                name,
                f"{modulus / unit:.4g}",
                f"{interval.lower / unit:.4g} to {interval.upper / unit:.4g}",
                f"{interval.factor:.3f}",
                f"{interval.weight:.2f}",
            )
        )
    return "\n".join([*aligned(rows), "", _left_over(found), *found.remarks])


def _unit(found: StiffnessFit, name: str) -> float:
    """Unit in which a constant is shown: kPa, or none."""
    return 1.0 if name in found.stiffenings else 1e3


def _left_over(found: StiffnessFit) -> str:
    force, torque, landmark = (found.scatter(kind) for kind in ("force", "torque", "landmark"))
    parts = []
    if force is not None:
        its = found.observations.groups == 0
        largest = float(np.abs(found.modelled[its] - _offsets(found)[its]).max())
        parts.append(f"{force:.3g} N of forces up to {largest:.3g} N")
    if torque is not None:
        parts.append(f"{1e3 * torque:.3g} mN m of torques")
    if landmark is not None:
        parts.append(f"{1e3 * landmark:.3g} mm of landmarks")
    return (
        f"left over (RMS): {', '.join(parts)}; {counted(len(found.depths), 'pose')} down to "
        f"{1e3 * found.depths.max():.1f} mm, {counted(found.fitted.steps, 'step')}"
    )


def _offsets(found: StiffnessFit) -> np.ndarray:
    return np.asarray(found.observations.nuisance @ found.fitted.nuisance)


def write_moduli(file: Path, found: StiffnessFit, base: Mapping[str, str], name: str) -> None:
    """Write a scene that is based on another and has the fitted moduli.

    Args:
        file: of the new scene.
        found: the moduli.
        base: key and value that name the fitted scene: ``based_on`` a scene, or a ``case``.
        name: of that scene.

    Raises:
        StiffnessError: it cannot be written.
    """
    materials = {
        structure: {key: float(f"{value:.6g}") for key, value in constants.items()}
        for structure, constants in found.constants.items()
    }
    document = {"name": f"{name}_fitted", **base, "tissue": {"materials": materials}}
    told = "".join(f"# {line}".rstrip() + "\n" for line in table(found).splitlines())
    text = (
        "# Young's moduli (Pa) fitted to a recorded press by `us-sim fit-stiffness`.\n"
        f"#\n{told}" + yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    )
    partial = file.with_name(f".{file.name}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, file)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise StiffnessError(f"{file}: cannot be written: {error.strerror}") from error


_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_SCALES = {"force": (1.0, "N"), "torque": (1e3, "mN m"), "landmark": (1e3, "mm")}


def draw_fit(file: Path, found: StiffnessFit, title: str) -> None:
    """Write a PNG.

    Raises:
        StiffnessError: it cannot be written.
    """
    kinds = [GROUPS[k] for k in np.unique(found.observations.groups)]
    figure = Figure(figsize=(12, 2.6 + 2.4 * len(kinds)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12, x=0.01, ha="left")
    rows = figure.subplots(len(kinds) + 1, 2, squeeze=False)
    for (over_time, left_over), kind in zip(rows[:-1], kinds, strict=True):
        _draw_kind(over_time, left_over, found, kind)
    for panel in rows[-2][:2]:
        panel.set_xlabel("time (s)")
    _draw_force_over_depth(rows[-1][0], found)
    _draw_moduli(rows[-1][1], found)
    partial = file.with_name(f".{file.name}.partial")
    try:
        figure.savefig(partial, format="png")
        os.replace(partial, file)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise StiffnessError(f"{file}: cannot be written: {error.strerror}") from error


def _draw_kind(over_time: Axes, left_over: Axes, found: StiffnessFit, kind: str) -> None:
    observed = found.observations
    scale, unit = _SCALES[kind]
    its = observed.groups == GROUPS.index(kind)
    offsets = observed.nuisance @ found.fitted.nuisance
    for place, (label, chosen) in enumerate(_channels(found, its, kind)):
        order = chosen[np.argsort(observed.times[chosen], kind="stable")]
        times, colour = observed.times[order], _COLOURS[place % len(_COLOURS)]
        modelled = scale * (found.modelled - offsets)[order]
        measured = scale * (observed.values - offsets)[order]
        if kind == "landmark":
            over_time.plot(modelled, measured, ".", color=colour, markersize=4, label=label)
        else:
            over_time.plot(times, measured, ".", color=colour, markersize=4, label=label)
            over_time.plot(times, modelled, "-", color=colour, linewidth=1.0)
        left_over.plot(times, scale * found.fitted.residual[order], ".", color=colour, markersize=4)
    over_time.set_ylabel(f"{kind} ({unit})")
    over_time.set_title(f"{kind}s measured (dots) and modelled (lines)", fontsize=9, loc="left")
    if kind == "landmark":
        over_time.set_title("places seen over places modelled", fontsize=9, loc="left")
    over_time.legend(fontsize=8, frameon=False)
    left_over.axhline(0.0, color="0.6", linewidth=0.8)
    left_over.set_ylabel(f"left over ({unit})")
    scatter = scale * (found.scatter(kind) or 0.0)
    left_over.set_title(f"left over, RMS {scatter:.3g} {unit}", fontsize=9, loc="left")
    for panel in (over_time, left_over):
        _plain(panel)


def _channels(found: StiffnessFit, its: np.ndarray, kind: str) -> list[tuple[str, np.ndarray]]:
    observed = found.observations
    if kind == "landmark":
        numbers = np.flatnonzero(its).reshape(-1, 3)
        return [(axis, numbers[:, k]) for k, axis in enumerate("xyz")]
    return [
        (CHANNELS[channel][-1], np.flatnonzero(its & (observed.nuisance[:, place] == 1.0)))
        for place, channel in enumerate(observed.channels)
        if (channel < 3) == (kind == "force")
    ]


def _draw_force_over_depth(panel: Axes, found: StiffnessFit) -> None:
    observed = found.observations
    pressed = observed.depths > 0.0
    for place, channel in enumerate(observed.channels):
        if channel == 2:
            its = np.flatnonzero(pressed & (observed.nuisance[:, place] == 1.0))
            offset = (observed.nuisance @ found.fitted.nuisance)[its]
            depth = 1e3 * observed.depths[its]
            panel.plot(depth, -(observed.values[its] - offset), "k.", label="measured")
            panel.plot(
                depth,
                -(found.modelled[its] - offset),
                "o",
                color="#D55E00",
                mfc="none",
                markersize=6,
                label="modelled",
            )
            panel.legend(fontsize=8, frameon=False)
    panel.set_xlabel("depth in the undeformed tissue (mm)")
    panel.set_ylabel("force against the probe (N)")
    _plain(panel)


def _draw_moduli(panel: Axes, found: StiffnessFit) -> None:
    names = list(found.moduli)
    for row, name in enumerate(names):
        unit, interval = _unit(found, name), found.intervals.get(name)
        modulus = found.moduli[name] / unit
        if interval is None:
            panel.plot(modulus, row, "o", color="0.5", mfc="none")
            continue
        panel.plot([interval.lower / unit, interval.upper / unit], [row, row], "-", color="#0072B2")
        panel.plot(modulus, row, "o", color="#0072B2")
    panel.set_xscale("log")
    panel.set_yticks(range(len(names)), names)
    panel.invert_yaxis()
    panel.set_xlabel(f"Young's modulus (kPa), {100 * found.confidence:g} % intervals; hollow: kept")
    _plain(panel)


def _plain(panel: Axes) -> None:
    panel.grid(True, color="0.93")
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8.5)
