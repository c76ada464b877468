"""The report of an import: its facts by names and never by values.

The picture shows the first image as it was, so that a person sees what is burned in. It belongs
where the original is kept, and not to the case.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.spelling import counted
from us_sim.volume.deidentification.importing import Import
from us_sim.volume.deidentification.kept_values import NUMBERS
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
    reasons = {one.name: f": {one.why}" for one in NUMBERS}
    reasons["frame_of_reference_uid"] = ": a new one of random numbers, in place of the original's"
    said += [
        "## Kept as they are",
        _listed({name + reasons.get(name, ""): 1 for name in source.kept}),
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


def report_picture(planned: Import) -> NDArray[np.uint8]:
    """Return (rows, columns, 3) the first image as it was, with boxes around its kept parts."""
    picture = np.asarray(cv2.cvtColor(planned.source.first, cv2.COLOR_GRAY2BGR), np.uint8)
    for box in planned.parts:
        cv2.rectangle(picture, box[:2], box[2:], (80, 220, 80), 1)
    return picture


def write_report(folder: Path, planned: Import) -> list[Path]:
    """Write the report and its picture into a new folder, or one without a report."""
    refuse_report(folder)
    picture = cv2.imencode(".png", report_picture(planned))[1].tobytes()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise VolumeError(f"{folder}: cannot be written: {error.strerror}") from error
    texts = {_PICTURE: picture, _REPORT: report_text(planned, _PICTURE).encode()}
    for name, content in texts.items():
        with partial_file(folder / name) as partial:
            partial.touch(0o600)  # the owner's alone
            partial.write_bytes(content)
    return [folder / _REPORT, folder / _PICTURE]


def refuse_report(folder: Path) -> None:
    """Refuse a place for a report where there is one, or a file."""
    if (folder.exists() and not folder.is_dir()) or (folder / _REPORT).exists():
        raise VolumeError(
            f"--report {folder}: is a file or has a report already; name a new folder"
        )


def _listed(names: Mapping[str, int]) -> str:
    lines = [f"- {name}{f' ({n} times)' if n > 1 else ''}" for name, n in names.items()]
    return "\n".join(lines) or "Nothing."
