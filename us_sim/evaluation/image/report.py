"""image.md: what was asked and seen, and a part for each artefact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.target import target_table

Measured = Mapping[Artefact, Sequence[Point]]


def table(measured: Measured) -> str:
    """What the command prints: every measure that is asked for, and what was seen."""
    return target_table(
        [t for artefact, points in measured.items() for t in _asked(artefact, points)]
    )


def write_report(folder: ReportFolder, measured: Measured) -> None:
    """Draw the pictures and write image.md."""
    parts = [
        "# Image: artefacts against closed forms",
        "",
        "## What is asked",
        table(measured),
        "Errors of echoes are those of their amplitude. Times are processor time of one thread.",
    ]
    for artefact, points in measured.items():
        parts.append(f"## {artefact.title}")
        if not failures(points):
            parts += artefact.report(points, folder)
    parts += ["## What is simplified", _simplified(measured)]
    parts[1] = folder.opening("numpy", "numba", "opencv-python-headless", "opencv-python")
    folder.write_report(parts, failures([p for points in measured.values() for p in points]))


def _asked(artefact: Artefact, points: Sequence[Point]) -> list:
    return [] if failures(points) else artefact.targets(points)


def _simplified(measured: Measured) -> str:
    return "\n".join(f"- {artefact.title}: {artefact.simplified}" for artefact in measured)
