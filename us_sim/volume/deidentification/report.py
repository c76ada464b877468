"""The report of an import: its facts by names and never by values.

The picture shows the first image as it was, so that a person sees what is burned in. It belongs
where the original is kept, and not to the case.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.spelling import counted
from us_sim.volume.deidentification.importing import Imported
from us_sim.volume.deidentification.kept_values import NUMBERS

_REPORT, _PICTURE = "report.md", "first_image.png"


def report_text(imported: Imported, picture: str = "") -> str:
    """The report as Markdown, with the name of its picture where there is one."""
    files = "1 file" if imported.files == 1 else f"{imported.files} files"
    lines = ["# Import", "", f"{files}: {imported.kind}. Made of it: {imported.what}.", ""]
    if imported.undecided:
        lines += [f"**Nothing can be written yet**: {imported.undecided}.", ""]
    lines += [f"Blanked: {imported.blanked}.", ""]
    if imported.conversions:
        lines += [f"Converted: {'; '.join(imported.conversions)}.", ""]
    if picture:
        lines += [
            f"![The first image]({picture})",
            "",
            "*The first image as it was. Green: kept. It may show a name: keep it where the "
            "original is kept.*",
            "",
        ]
    reasons = {one.name: f": {one.why}" for one in NUMBERS}
    reasons["frame_of_reference_uid"] = ": a new one of random numbers, in place of the original's"
    lines += ["## Kept as they are", ""]
    lines += _listed({name + reasons.get(name, ""): 1 for name in imported.kept})
    lines += ["", "## Dropped", ""]
    lines += ["The grid, the times, the grey values and what is blanked come of some of these.", ""]
    lines += ["Names only: with values this report would say whose it is.", ""]
    lines += _listed(imported.dropped)
    return "\n".join([*lines, ""])


def summary(imported: Imported) -> str:
    """The report in a sentence or two."""
    said = [imported.what, f"blanked: {imported.blanked}", *imported.conversions]
    dropped = sum(imported.dropped.values())
    said.append(f"{counted(dropped, 'element')} of the header dropped, {len(imported.kept)} kept")
    return "; ".join(said)


def report_picture(imported: Imported) -> NDArray[np.uint8]:
    """Return (rows, columns, 3) the first image as it was, with boxes around its kept parts."""
    picture = np.asarray(cv2.cvtColor(imported.first, cv2.COLOR_GRAY2BGR), np.uint8)
    for box in imported.parts:
        first, last = (box.left, box.top), (box.right, box.bottom)
        cv2.rectangle(picture, first, last, (80, 220, 80), 1)
    return picture


def write_report(folder: Path, imported: Imported) -> list[Path]:
    """Write the report and its picture into a new folder, or one without a report.

    Raises:
        VolumeError: there is one already, or it cannot be written.
    """
    refuse_report(folder)
    done, data = cv2.imencode(".png", report_picture(imported))
    assert done
    written = {_PICTURE: data.tobytes(), _REPORT: report_text(imported, _PICTURE).encode()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in written.items():
            number, partial = tempfile.mkstemp(prefix=f".{name}.partial-", dir=folder)
            try:
                with os.fdopen(number, "wb") as file:  # the owner's alone, as mkstemp makes it
                    file.write(content)
                os.replace(partial, folder / name)
            finally:
                Path(partial).unlink(missing_ok=True)
    except OSError as error:
        raise VolumeError(f"{folder}: cannot be written: {error.strerror}") from error
    return [folder / _REPORT, folder / _PICTURE]


def refuse_report(folder: Path) -> None:
    """Refuse a place for a report where there is one, or a file.

    Raises:
        VolumeError: there is.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise VolumeError(f"--report {folder}: is a file; name a folder for the report")
    if os.path.lexists(folder / _REPORT):
        raise VolumeError(f"--report {folder}: holds a report already; name another folder")


def _listed(names: Mapping[str, int]) -> list[str]:
    if not names:
        return ["Nothing."]
    return [f"- {name}{f' ({count} times)' if count > 1 else ''}" for name, count in names.items()]
