"""Report of a stiffness fit: a table, a scene with the moduli, a picture of how they fit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from us_sim.errors import StiffnessError
from us_sim.settings.spelling import aligned, counted
from us_sim.tissue.identification.press_record import CHANNELS
from us_sim.tissue.identification.stiffness import GROUPS, StiffnessFit
from us_sim.volume.partial_file import partial_file


def table(found: StiffnessFit) -> str:
    """Structures with their moduli, intervals and part in the force, and the residuals."""
    percent = f"{100 * found.confidence:g} %"
    heading = ("structure", "E (kPa)", f"{percent} interval (kPa)", "×/÷", "part of force")
    rows: list[tuple[str, ...]] = [heading]
    for name, modulus in found.moduli.items():
        unit, interval = _unit(found, name), found.intervals.get(name)
        cells = ["kept", "", ""]
        if interval is not None:
            limits = f"{interval.lower / unit:.4g} to {interval.upper / unit:.4g}"
            cells = [limits, f"{interval.factor:.3f}", f"{interval.weight:.2f}"]
        rows.append((name, f"{modulus / unit:.4g}", *cells))
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
    with partial_file(file, error_type=StiffnessError) as partial:
        partial.write_text(text, encoding="utf-8")


_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_SCALES = {"force": (1.0, "N"), "torque": (1e3, "mN m"), "landmark": (1e3, "mm")}


def draw_fit(file: Path, found: StiffnessFit, title: str) -> None:
    """Write a PNG.

    Raises:
        StiffnessError: it cannot be written.
    """
    kinds = [GROUPS[k] for k in np.unique(found.observations.groups)]
    figure = Figure(figsize=(12, 2.6 + 2.4 * len(kinds)), dpi=100, layout="constrained")
    figure.suptitle(title, fontsize=12, x=0.01, ha="left")
    *panels, moduli = figure.subplots(len(kinds) + 1)
    for panel, kind in zip(panels, kinds, strict=True):
        _draw_kind(panel, found, kind)
    _draw_moduli(moduli, found)
    for panel in (*panels, moduli):
        panel.grid(True, color="0.93")
    with partial_file(file, error_type=StiffnessError) as partial:
        figure.savefig(partial, format="png")


def _draw_kind(panel: Axes, found: StiffnessFit, kind: str) -> None:
    observed = found.observations
    scale, unit = _SCALES[kind]
    offsets = _offsets(found)
    for place, (label, chosen) in enumerate(_channels(found, kind)):
        order = chosen[np.argsort(observed.times[chosen], kind="stable")]
        colour = _COLOURS[place % len(_COLOURS)]
        modelled = scale * (found.modelled - offsets)[order]
        measured = scale * (observed.values - offsets)[order]
        if kind == "landmark":
            panel.plot(modelled, measured, ".", color=colour, markersize=4, label=label)
        else:
            times = observed.times[order]
            panel.plot(times, measured, ".", color=colour, markersize=4, label=label)
            panel.plot(times, modelled, "-", color=colour, linewidth=1.0)
    left = f"left over, RMS {scale * (found.scatter(kind) or 0.0):.3g} {unit}"
    if kind == "landmark":
        panel.set(xlabel="modelled (mm)", ylabel="seen (mm)", title=f"landmarks; {left}")
    else:
        title = f"{kind}s measured (dots) and modelled (lines); {left}"
        panel.set(xlabel="time (s)", ylabel=f"{kind} ({unit})", title=title)
    panel.legend(fontsize=8, frameon=False)


def _channels(found: StiffnessFit, kind: str) -> list[tuple[str, np.ndarray]]:
    observed = found.observations
    its = observed.groups == GROUPS.index(kind)
    if kind == "landmark":
        numbers = np.flatnonzero(its).reshape(-1, 3)
        return [(axis, numbers[:, k]) for k, axis in enumerate("xyz")]
    return [
        (CHANNELS[channel][-1], np.flatnonzero(its & (observed.nuisance[:, place] == 1.0)))
        for place, channel in enumerate(observed.channels)
        if (channel < 3) == (kind == "force")
    ]


def _draw_moduli(panel: Axes, found: StiffnessFit) -> None:
    for row, (name, modulus) in enumerate(found.moduli.items()):
        unit, interval = _unit(found, name), found.intervals.get(name)
        if interval is not None:
            ends = [interval.lower / unit, interval.upper / unit]
            panel.plot(ends, [row, row], "-", color="#0072B2")
        fill = "none" if interval is None else "#0072B2"
        panel.plot(modulus / unit, row, "o", color="#0072B2", mfc=fill)
    panel.set_xscale("log")
    panel.set_yticks(range(len(found.moduli)), list(found.moduli))
    panel.invert_yaxis()
    panel.set_xlabel(f"Young's modulus (kPa), {100 * found.confidence:g} % intervals; hollow: kept")
