"""`us-sim evaluate image`: what images show of sound, strain and flow, against closed forms."""

from __future__ import annotations

from pathlib import Path

from us_sim.evaluation.image.angles import Fibres, Surfaces
from us_sim.evaluation.image.arm_tilts import ArmTilts
from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.attenuation import Attenuation
from us_sim.evaluation.image.enhancement import Enhancement
from us_sim.evaluation.image.flow import Flow
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.image.report import table, write_report
from us_sim.evaluation.image.run_time import RunTime
from us_sim.evaluation.image.shadow import Shadow
from us_sim.evaluation.image.strain import StrainImages
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures, words_of
from us_sim.evaluation.steps import steps

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
