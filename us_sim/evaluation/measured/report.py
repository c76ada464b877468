"""`us-sim evaluate measured`: measured.csv, pictures, and measured.md."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from threadpoolctl import threadpool_limits

from us_sim.errors import UsSimError
from us_sim.evaluation.measured import hydrogel, nwires, silicone, vein
from us_sim.evaluation.measured.study import Section, Study
from us_sim.evaluation.report import ReportFolder, markdown_table
from us_sim.evaluation.settings import MeasuredData
from us_sim.evaluation.timing import steps

STUDIES: tuple[Study, ...] = (
    hydrogel.STUDY,
    silicone.STUDY,
    nwires.STUDY,
    vein.STUDY,
)


def evaluate_measured(out: Path, quick: bool, settings: MeasuredData | None = None) -> int:
    """Write the CSV file, the pictures and measured.md, as `us_sim.evaluation` says.

    Studies whose data are not there are left out; the report says where they are to be had.

    Raises:
        UsSimError: besides, there is no study whose data are there, or none in a folder that was
            named.
    """
    data = _data(settings.data if settings else None)
    absent = [study for study in STUDIES if study.folder and not _folder(data, study).is_dir()]
    present = [study for study in STUDIES if study not in absent]
    if not any(study.folder or data is None for study in present):
        folders = ", ".join(study.folder for study in STUDIES if study.folder)
        raise UsSimError(
            f"no measured data in {data or 'the present folder'}: name with --data, or with "
            f"US_SIM_TEST_DATA, the folder that has one or more of these: {folders}"
        )
    folder = ReportFolder("measured", out, quick)
    with threadpool_limits(1):  # as live; threads that wait would count as time of a frame
        sections = [
            study.measure(_folder(data, study), folder)
            for study in steps("measured", present, "studies", lambda study: study.name)
        ]
    findings = [finding for section in sections for finding in section.findings]
    folder.write_rows("measured", findings)
    shown = [finding for finding in findings if finding.headline]
    table = markdown_table(list(findings[0].values), [finding.cells for finding in shown])
    return folder.finish(
        table,
        (),
        ("numpy", "numba", "scipy"),
        table=table,
        sections="\n\n".join(map(_section, sections)),
        absent=_sources("Left out, since the data are not there", absent),
        sources=_sources("Data", [study for study in present if study.folder]),
    )


def _data(named: Path | None) -> Path | None:
    """The folder of all data: the one that was named, or that of US_SIM_TEST_DATA."""
    environment = os.environ.get("US_SIM_TEST_DATA")
    data = named or (Path(environment) if environment else None)
    if data is not None and not data.is_dir():
        raise UsSimError(
            f"{data}, the folder of measured data, is no folder: name another with --data"
        )
    return data


def _folder(data: Path | None, study: Study) -> Path:
    return (data or Path()) / study.folder


def _section(section: Section) -> str:
    return f"## {section.heading}\n\n{section.text.strip()}"


def _sources(heading: str, studies: Sequence[Study]) -> str:
    """A heading and a line for each study; empty without studies."""
    if not studies:
        return ""
    lines = [
        f"- {study.name}: {study.address}, {study.licence}, into the folder `{study.folder}`. "
        f"{study.citation}"
        for study in studies
    ]
    return f"## {heading}\n\n" + "\n".join(lines)
