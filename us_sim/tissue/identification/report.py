"""What a stiffness fit says to a person: a table, and a scene's file of the moduli."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from us_sim.errors import StiffnessError
from us_sim.settings.spelling import counted
from us_sim.tissue.identification.stiffness import StiffnessFit


def table(found: StiffnessFit) -> str:
    """Structures with their moduli, intervals and part in the force; then what is left over."""
    percent = f"{100 * found.confidence:g} %"
    rows = [("structure", "E (kPa)", f"{percent} interval (kPa)", "×/÷", "part of force")]
    for name, modulus in found.moduli.items():
        interval = found.intervals.get(name)
        if interval is None:
            rows.append((name, f"{modulus / 1e3:.4g}", "kept", "", ""))
            continue
        rows.append(
            (
                name,
                f"{modulus / 1e3:.4g}",
                f"{interval.lower / 1e3:.4g} to {interval.upper / 1e3:.4g}",
                f"{interval.factor:.3f}",
                f"{interval.weight:.2f}",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    return "\n".join([*lines, "", _left_over(found), *found.remarks])


def _left_over(found: StiffnessFit) -> str:
    """RMS of the residuals, in a line."""
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
    """(n,) what the sensor's offsets and delay make of the measurements."""
    return np.asarray(found.observations.nuisance @ found.fitted.nuisance)


def write_moduli(file: Path, found: StiffnessFit, base: Mapping[str, str], name: str) -> None:
    """Write a scene that is based on another and has the fitted moduli.

    Args:
        file: of the new scene.
        found: the moduli.
        base: the key that names what was fitted: ``based_on`` a scene, or a ``case``.
        name: of that scene.

    Raises:
        StiffnessError: it cannot be written.
    """
    materials = {
        structure: {"young_modulus": float(f"{found.moduli[structure]:.6g}")}
        for structure in found.intervals
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
