"""image.md: what was asked and seen, and a part for each artefact.

`us-sim evaluate image`: what images show of sound, strain and flow, against closed forms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from us_sim.evaluation.image.acoustics import Attenuation, Enhancement, Fibres, Shadow, Surfaces
from us_sim.evaluation.image.arm import ArmTilts, RunTime
from us_sim.evaluation.image.flow import Flow
from us_sim.evaluation.image.measure import Artefact, Point
from us_sim.evaluation.image.strain import StrainImages
from us_sim.evaluation.report import ReportFolder, failures, target_table, words_of
from us_sim.evaluation.timing import steps

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


ARTEFACTS: tuple[Artefact, ...] = (
    Attenuation(),
    Enhancement(),
    Shadow(),
    Surfaces(),
    Fibres(),
    ArmTilts(),
    StrainImages(),
    Flow(),
    RunTime(),
)
"""In the order of the report."""


def evaluate_image(out: Path, quick: bool) -> int:
    """Write image.csv, the pictures and image.md, as `us_sim.evaluation` says.

    A quick run has fewer probes, tilts and repetitions.
    """
    folder = ReportFolder("image", out, quick)
    measured = {
        artefact: _points(artefact, quick)
        for artefact in steps("image", ARTEFACTS, "artefacts", lambda one: one.name)
    }
    points = [point for some in measured.values() for point in some]
    folder.write_rows("image", points)
    write_report(folder, measured)
    return folder.finish(table(measured), failures(points))


def _points(artefact: Artefact, quick: bool) -> list[Point]:
    try:
        return artefact.points(quick)
    # Whatever breaks in one artefact must not take the others' results along.
    except Exception as error:
        return [Point(artefact.name, "", failure=words_of(error))]
