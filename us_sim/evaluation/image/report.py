"""`us-sim evaluate image`: sound, strain and flow in images, against closed forms."""

from __future__ import annotations

from pathlib import Path

from us_sim.evaluation.image.acoustics import Attenuation, Enhancement, Fibres, Shadow, Surfaces
from us_sim.evaluation.image.arm import ArmTilts, RunTime
from us_sim.evaluation.image.flow import Flow
from us_sim.evaluation.image.measure import Artefact, Point
from us_sim.evaluation.image.strain import StrainImages
from us_sim.evaluation.report import ReportFolder, failures, target_table, words_of
from us_sim.evaluation.timing import steps

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
    whole = {artefact: some for artefact, some in measured.items() if not failures(some)}
    table = target_table([t for artefact, some in whole.items() for t in artefact.targets(some)])
    parts = []
    for artefact in measured:
        parts.append(f"## {artefact.title}")
        if artefact in whole:
            parts.append(artefact.report(whole[artefact], folder))
    libraries = ("numpy", "numba", "opencv-python-headless", "opencv-python")
    text = "\n\n".join(parts)
    return folder.finish(table, failures(points), libraries, targets=table, parts=text)


def _points(artefact: Artefact, quick: bool) -> list[Point]:
    try:
        return artefact.points(quick)
    # Whatever breaks in one artefact must not take the others' results along.
    except Exception as error:
        return [Point(artefact.name, "", failure=words_of(error))]
