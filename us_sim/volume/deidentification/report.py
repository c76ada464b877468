"""The report of an import: its facts by names and never by values.

The picture shows the first image as it was, so that a person sees what is burned in. It belongs
where the original is kept, and not to the case.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from us_sim.errors import VolumeError
from us_sim.settings.spelling import counted
from us_sim.volume.deidentification.importing import Import
from us_sim.volume.partial_file import partial_file

_REPORT, _PICTURE = "report.md", "first_image.png"


def report_text(planned: Import, picture: str = "") -> str:
    """Return the report as Markdown, with the name of its picture where there is one."""
    source = planned.source
    said = [f"{counted(len(planned.paths), 'file')}: {source.kind}. Made of it: {planned.what}."]
    if planned.undecided:
        said.append(f"**Nothing can be written yet**: {planned.undecided}.")
    said.append(f"Blanked: {planned.blanked}.")
    if source.conversions:
        said.append(f"Converted: {'; '.join(source.conversions)}.")
    if picture:
        said += [
            f"![The first image]({picture})",
            "*The first image as it was. Green: kept. It may show a name: keep it where the "
            "original is kept.*",
        ]
    said += [
        "## Kept as they are",
        _listed(dict.fromkeys(source.kept, 1)),
        "## Dropped",
        "The grid, the times, the grey values and what is blanked come of some of these. Names "
        "only: with values this report would say whose it is.",
        _listed(source.dropped),
    ]
    return "\n\n".join(["# Import", *said, ""])


def summary(planned: Import) -> str:
    """Return the report in a sentence or two."""
    source = planned.source
    said = [planned.what, f"blanked: {planned.blanked}", *source.conversions]
    dropped = sum(source.dropped.values())
    said.append(f"{counted(dropped, 'element')} of the header dropped, {len(source.kept)} kept")
    return "; ".join(said)


def write_report(folder: Path, planned: Import) -> list[Path]:
    """Write the report and its picture into a new folder, or one without a report.

    The picture is the first image as it was, with boxes around its kept parts.
    """
    refuse_report(folder)
    picture = np.asarray(cv2.cvtColor(planned.source.first, cv2.COLOR_GRAY2BGR), np.uint8)
    for box in planned.parts:
        cv2.rectangle(picture, box[:2], box[2:], (80, 220, 80), 1)
    folder.mkdir(parents=True, exist_ok=True)
    content = {
        folder / _REPORT: report_text(planned, _PICTURE).encode(),
        folder / _PICTURE: cv2.imencode(".png", picture)[1].tobytes(),
    }
    for path, data in content.items():
        with partial_file(path) as partial:
            partial.touch(0o600)  # the owner's alone
            partial.write_bytes(data)
    return list(content)


def refuse_report(folder: Path) -> None:
    """Refuse a place for a report where there is one, or a file."""
    if (folder.exists() and not folder.is_dir()) or (folder / _REPORT).exists():
        raise VolumeError(
            f"--report {folder}: is a file or has a report already; name a new folder"
        )


def _listed(names: Mapping[str, int]) -> str:
    lines = [f"- {name}{f' ({n} times)' if n > 1 else ''}" for name, n in names.items()]
    return "\n".join(lines) or "Nothing."
