"""Segmentation of a case: labels, surfaces and a picture.

Everything is computed before the first file is written, and each file is replaced whole.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np

from us_sim import Progress
from us_sim.errors import CaseError, VolumeError
from us_sim.settings.spelling import align_columns
from us_sim.share import shared_roots
from us_sim.volume.cases.case import LABELS, SURFACES, VOLUME, read_case
from us_sim.volume.cases.proposal import complete_settings
from us_sim.volume.cases.settings import RESERVED, CaseSettings, CaseStructure
from us_sim.volume.cases.writing import write_case_settings
from us_sim.volume.files.labels import read_labels
from us_sim.volume.files.readers import read_volume
from us_sim.volume.files.writing import write_labels
from us_sim.volume.partial_file import partial_file
from us_sim.volume.segmentation.settings import SegmentRequest, read_seeds
from us_sim.volume.segmentation.structures import segment_volume
from us_sim.volume.structure_names import choose_colour
from us_sim.volume.surfaces.label_surface import make_label_surface, write_stl
from us_sim.volume.volume import LabelMap, Volume

PICTURE = "segmentation.png"
_HEADING = ("structure", "volume", "triangles")


def run_segmentation(asked: SegmentRequest, progress: Progress = lambda *_: None) -> str:
    """Segment a case; return the result in lines for a person.

    Raises:
        VolumeError: a file cannot be read or used, or there are no labels.
        CaseError: the case cannot be read or changed.
    """
    if asked.case.is_file():
        raise CaseError(f"{asked.case}: make a case of it first: us-sim import FILE --out CASE")
    from us_sim.command.volume_pictures import draw_segmentation

    case = read_case(asked.case)
    progress(0.0, "reading")
    volume = case.read_volume() if _keeps_labels(asked) else read_volume(case.folder / VOLUME)
    labels = _make_labels(asked, volume, progress)
    volume, remarks = labels.apply_to(volume), list(labels.remarks)
    settings = _add_structures(case.settings, labels, remarks)
    surfaces = {}
    for number, (label, name) in enumerate(sorted(labels.names.items())):
        progress(0.8 + 0.1 * number / len(labels.names), f"surface of {name}")
        surfaces[name] = make_label_surface(volume, label)
    settings, folder = complete_settings(settings, volume), case.folder
    with partial_file(folder / PICTURE, PICTURE) as partial:
        draw_segmentation(volume, labels, partial)
    if not _keeps_labels(asked):
        write_labels(folder / LABELS, volume, labels.colours)
    write_case_settings(folder, settings)
    shutil.rmtree(folder / SURFACES, ignore_errors=True)
    (folder / SURFACES).mkdir()
    for name, surface in surfaces.items():
        write_stl(folder / SURFACES / f"{name}.stl", *surface)
    progress(1.0, "")
    millilitres = 1e6 * abs(float(np.linalg.det(volume.index_to_patient[:3, :3])))
    rows = [_HEADING] + [
        (name, f"{labels.voxels[name] * millilitres:.3f} ml", str(len(triangles)))
        for name, (_, triangles) in surfaces.items()
    ]
    notes = (f"note: {remark}" for remark in remarks)
    return "\n".join([*align_columns(rows), *notes, f"written to {asked.case}"])


def _keeps_labels(asked: SegmentRequest) -> bool:
    return asked.labels is None and asked.seeds is None


def _make_labels(asked: SegmentRequest, volume: Volume, progress: Progress) -> LabelMap:
    """Read the labels, grow them from seeds, or keep the case's own, as asked for."""
    if asked.labels is not None:
        return read_labels(asked.labels, volume, names=asked.given_names(), taken=RESERVED)
    if asked.seeds is not None:
        seeds = read_seeds(_find_seeds(asked.seeds))
        return segment_volume(volume, seeds, lambda done, part: progress(0.1 + 0.7 * done, part))
    names = {label: name for label, name in volume.label_names.items() if label}
    if volume.labels is None or not names:
        raise VolumeError(f"{asked.case}: has no labels yet: give --labels or --seeds")
    return LabelMap(volume.labels, names)


def _find_seeds(path: Path) -> Path:
    """Return the file of seeds at the path, or the installed one with that name."""
    if os.path.exists(path):
        return path
    folders = [root / "config" / "seeds" for root in shared_roots()]
    installed = {file.stem: file for folder in folders for file in folder.glob("*.yaml")}
    if path.stem not in installed or path.name != str(path):
        names = ", ".join(sorted(installed))
        raise VolumeError(f"--seeds {path}: there is no such file; installed are {names}")
    return installed[path.stem]


def _add_structures(settings: CaseSettings, labels: LabelMap, remarks: list[str]) -> CaseSettings:
    """Return the case's settings with the labels' structures; known ones keep their materials.

    Raises:
        CaseError: a name has another meaning in a case.
    """
    structures = {}
    for label, name in labels.names.items():
        before = settings.structures.get(name)
        colour = labels.colours[label] if labels.colours[label] != choose_colour(name) else None
        material = before.material if before is not None else None
        structures[name] = CaseStructure(label=label, material=material, colour=colour)
    gone = [name for name in settings.structures if name not in structures]
    if gone:
        remarks.append(f"{', '.join(gone)}: was a structure of the case and is none now")
    fixed = tuple(name for name in settings.fixed if name not in gone)
    try:
        return dataclasses.replace(settings, structures=structures, fixed=fixed)
    except CaseError as error:
        numbers = {f"structures.{name}": label for label, name in labels.names.items()}
        hint = f"; for a file of labels that is --names {numbers.get(error.key, 'LABEL')}=NAME"
        raise CaseError(f"{error.key}: {error.problem}{hint}") from error
