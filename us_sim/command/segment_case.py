"""Segmentation of a case, or of a volume file into a folder: labels, surfaces, picture, report.

All of it is there at the end, or nothing is changed.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from us_sim.errors import CaseError, VolumeError
from us_sim.settings.choice import Chosen
from us_sim.settings.reading import document_of
from us_sim.settings.spelling import aligned
from us_sim.share import shared_roots
from us_sim.volume.cases.case import LABELS, SURFACES, TISSUE, VOLUME, is_case, read_case
from us_sim.volume.cases.provenance import Source, Step, add_step
from us_sim.volume.cases.settings import RESERVED, CaseSettings, CaseStructure
from us_sim.volume.cases.writing import changed_case, partial_folder, write_case_settings
from us_sim.volume.files.labels import read_labels
from us_sim.volume.files.readers import read_volume
from us_sim.volume.files.writing import write_labels
from us_sim.volume.segmentation.settings import (
    SegmentationSettings,
    SegmentRequest,
    StructureSeeds,
    read_seeds,
)
from us_sim.volume.segmentation.structures import segment
from us_sim.volume.structure_names import anatomical_colour
from us_sim.volume.surfaces.settings import SurfaceSettings
from us_sim.volume.surfaces.structure_surface import StructureSurface, structure_surface
from us_sim.volume.surfaces.surface_files import write_surface
from us_sim.volume.volume import LabelMap, Volume

PICTURE = "segmentation.png"
REPORT = "segmentation.md"
_HEADING = ("structure", "volume", "triangles", "area", "parts", "handles", "volume kept")

Progress = Callable[[float, str], None]


def segment_as_asked(
    asked: SegmentRequest, surfaces: SurfaceSettings, progress: Progress = lambda *_: None
) -> str:
    """Segment a case or a volume file; the result in lines for a person.

    Raises:
        VolumeError: a file cannot be read or used, or nothing is found.
        CaseError: the case cannot be read or changed.
    """
    _check_places(asked)
    case = read_case(asked.case) if is_case(asked.case) else None
    progress(0.0, "reading")
    if case is None:
        volume = read_volume(asked.case)
    else:
        volume = case.volume() if _keeps_labels(asked) else read_volume(case.folder / VOLUME)
    labels, step = _labels(asked, volume, progress)
    volume, remarks = labels.on(volume), list(labels.remarks)
    settings = _with_structures(case.settings, labels, remarks) if case is not None else None
    made = _surfaces(volume, surfaces, progress)
    if settings is None:
        assert asked.out is not None
        with partial_folder(asked.out, VolumeError) as folder:
            write_labels(folder / "labels.seg.nrrd", volume, labels.colours)
            _write(folder, volume, labels, made, asked, remarks)
    else:
        with changed_case(asked.case) as folder:
            if not _keeps_labels(asked):
                write_labels(folder / LABELS, volume, labels.colours)
                if (folder / TISSUE).exists():
                    (folder / TISSUE).unlink()
                    remarks.append(f"{TISSUE} was made of other labels and is removed")
            write_case_settings(folder, settings)
            _write(folder, volume, labels, made, asked, remarks)
            triangles = {f"triangles of {one.name}": len(one.surface.triangles) for one in made}
            add_step(folder, step)
            add_step(folder, Step("surfaces made", document_of(surfaces), triangles))
    progress(1.0, "")
    return _summary(asked.out or asked.case, made, remarks)


def _check_places(asked: SegmentRequest) -> None:
    """Refuse what is no case and no volume file, and a place that cannot be written to."""
    if is_case(asked.case):
        if asked.out is not None:
            raise VolumeError(
                f"--out: {asked.case} is a case, which is changed in its place; leave --out away"
            )
        return
    if asked.case.is_dir():
        raise CaseError(
            f"{asked.case}: is no case, as it has no case.yaml; `us-sim cases` lists some"
        )
    if not asked.case.exists():
        raise VolumeError(
            f"{asked.case}: there is no such case or volume file; `us-sim cases` lists cases"
        )
    if asked.out is None:
        raise VolumeError(
            f"{asked.case}: is a volume file, not a case: say with --out which folder to make"
        )
    if os.path.lexists(asked.out):
        raise VolumeError(f"{asked.out}: exists already; choose another name, or remove it")


def _keeps_labels(asked: SegmentRequest) -> bool:
    return asked.labels is None and asked.seeds is None and asked.vessels is None


def _labels(asked: SegmentRequest, volume: Volume, progress: Progress) -> tuple[LabelMap, Step]:
    """The labels that are asked for, and their entry in the provenance."""
    if asked.labels is not None:
        labels = read_labels(
            asked.labels,
            volume,
            resample=asked.resample,
            table=asked.label_table,
            names=asked.given_names(),
            taken=RESERVED,
        )
        sources = (Source.of(asked.labels, "labels"),)
        settings = {"resample": asked.resample}
        return labels, Step("labels taken from a file", settings, _counts(labels), sources)
    if asked.seeds is not None:
        seeds = read_seeds(_seeds_file(asked.seeds))
    elif asked.vessels is not None:
        seeds = SegmentationSettings({"vessels": StructureSeeds(method=Chosen("dark_vessels"))})
    else:
        names = {label: name for label, name in volume.label_names.items() if label}
        if volume.labels is None or not names:
            raise VolumeError(
                f"{asked.case}: has no labels yet: give --labels, --seeds, or --vessels dark to "
                f"make some"
            )
        return LabelMap(volume.labels, names), Step("labels kept")
    labels = segment(volume, seeds, lambda done, part: progress(0.1 + 0.7 * done, part))
    # Without the description of the seeds, which is free text.
    said = {name: document_of(one) for name, one in seeds.structures.items()}
    return labels, Step("segmented", said, _counts(labels))


def _seeds_file(path: Path) -> Path:
    """The file of seeds at that path, or the installed one of that name."""
    if not os.path.exists(path) and path.name == str(path):
        for root in shared_roots():
            installed = root / "config" / "seeds" / path.with_suffix(".yaml")
            if installed.is_file():
                return installed
    return path


def _counts(labels: LabelMap) -> dict[str, int]:
    return {f"voxels of {name}": count for name, count in labels.voxels.items()}


def _surfaces(
    volume: Volume, settings: SurfaceSettings, progress: Progress
) -> list[StructureSurface]:
    made = []
    labels = sorted(label for label in volume.label_names if label)
    for number, label in enumerate(labels):
        progress(0.8 + 0.1 * number / len(labels), f"surface of {volume.label_names[label]}")
        made.append(structure_surface(volume, label, settings))
    return made


def _with_structures(settings: CaseSettings, labels: LabelMap, remarks: list[str]) -> CaseSettings:
    """The case's settings with these structures; one that was there keeps its material.

    Raises:
        CaseError: a name means something else in a case.
    """
    structures = {}
    for label, name in labels.names.items():
        before = settings.structures.get(name)
        colour = labels.colours[label] if labels.colours[label] != anatomical_colour(name) else None
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


def _write(
    folder: Path,
    volume: Volume,
    labels: LabelMap,
    made: list[StructureSurface],
    asked: SegmentRequest,
    remarks: list[str],
) -> None:
    """Surfaces, picture and report into a folder."""
    from us_sim.command.volume_pictures import draw_segmentation

    surfaces = folder / SURFACES
    surfaces.mkdir(exist_ok=True)
    for before in surfaces.iterdir():
        before.unlink()
    for one in made:
        for kind in dict.fromkeys(asked.formats):
            write_surface(surfaces / f"{one.name}.{kind}", one.surface)
    draw_segmentation(volume, labels, folder / PICTURE)
    (folder / REPORT).unlink(missing_ok=True)
    if asked.report:
        (folder / REPORT).write_text(_report(made, remarks), encoding="utf-8")


def _summary(where: Path, made: Sequence[StructureSurface], remarks: Sequence[str]) -> str:
    """A line for each structure, and the remarks."""
    rows = [_HEADING, *(_cells(one) for one in made)]
    notes = (f"note: {remark}" for remark in remarks)
    return "\n".join([*aligned(rows), *notes, f"written to {where}"])


def _report(made: Sequence[StructureSurface], remarks: Sequence[str]) -> str:
    """The same as Markdown, with the picture."""
    lines = ["# Segmentation", "", f"![slices with outlines, and surfaces]({PICTURE})", ""]
    lines += [f"| {' | '.join(_HEADING)} |", "|" + " --- |" * len(_HEADING)]
    lines += [f"| {' | '.join(_cells(one))} |" for one in made]
    lines += [
        "",
        "Volume is that of the labelled voxels; volume kept is what the surface encloses of it. "
        "Handles count how often a surface has a hole right through.",
        "",
        *(f"- {remark}" for remark in remarks),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _cells(one: StructureSurface) -> tuple[str, ...]:
    surface = one.surface
    return (
        one.name,
        f"{one.voxels_volume * 1e6:.3f} ml",
        str(len(surface.triangles)),
        f"{surface.area * 1e4:.2f} cm²",
        str(surface.parts),
        str(surface.genus),
        f"{100 * one.volume_kept:.2f} %",
    )
