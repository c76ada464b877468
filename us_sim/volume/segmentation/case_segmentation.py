"""A folder that is there whole at the end, or not at all.

What a segmentation came to, in lines for a person and as a page.

Segmentation of a case, or of a volume file into a folder: labels, surfaces, picture.

All of it is there at the end, or nothing is changed.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import CaseError, VolumeError
from us_sim.settings.choice import Chosen
from us_sim.settings.reading import document_of
from us_sim.share import shared_roots
from us_sim.volume.cases.case import LABELS, SURFACES, TISSUE, is_case, read_case
from us_sim.volume.cases.provenance import Source, Step, add_step
from us_sim.volume.cases.settings import RESERVED, CaseSettings, CaseStructure
from us_sim.volume.cases.writing import changed_case, write_case_settings
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


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder to write to, which gets its name at the end.

    Raises:
        VolumeError: there is something of that name, or it cannot be made.
    """
    if os.path.lexists(folder):
        raise VolumeError(f"{folder}: exists already; choose another name, or remove it")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.partial-", dir=folder.parent))
    except OSError as error:
        raise VolumeError(f"{folder}: cannot be made: {error.strerror}") from error
    try:
        mask = os.umask(0)
        os.umask(mask)
        partial.chmod(0o777 & ~mask)  # as any folder; mkdtemp's are the owner's alone
        yield partial
        try:
            os.rename(partial, folder)
        except OSError as error:
            raise VolumeError(f"{folder}: cannot be made: {error.strerror}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


_HEADING = ("structure", "volume", "triangles", "area", "parts", "handles", "volume kept", "moved")


def summary(where: Path, made: Sequence[StructureSurface], remarks: Sequence[str]) -> str:
    """A line for each structure, and what should be known."""
    rows = [_HEADING, *(_cells(one) for one in made)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADING))]
    lines = [
        "  ".join(
            cell.ljust(width) if not column else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    return "\n".join([*lines, *(f"note: {remark}" for remark in remarks), f"written to {where}"])


def write_report(
    file: Path, picture: str, made: Sequence[StructureSurface], remarks: Sequence[str]
) -> None:
    """The same as Markdown, with the picture."""
    lines = ["# Segmentation", "", f"![slices with outlines, and surfaces]({picture})", ""]
    lines += [f"| {' | '.join(_HEADING)} |", "|" + " --- |" * len(_HEADING)]
    lines += [f"| {' | '.join(_cells(one))} |" for one in made]
    lines += [
        "",
        "Volume is that of the labelled voxels; volume kept is what the surface encloses of it. "
        "Handles count how often a surface has a hole right through. Moved is the largest distance "
        "by which fewer triangles moved the surface.",
        "",
        *(f"- {remark}" for remark in remarks),
    ]
    file.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


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
        f"{one.moved * 1e3:.3f} mm",
    )


PICTURE = "segmentation.png"
REPORT = "segmentation.md"

Progress = Callable[[float, str], None]


def _silent(_: float, __: str) -> None:
    """Progress that nobody is told."""


@dataclass(frozen=True, eq=False)
class _Found:
    """Labels, and what provenance says of how they came about."""

    labels: LabelMap
    step: Step


def segment_as_asked(
    asked: SegmentRequest, surfaces: SurfaceSettings, progress: Progress = _silent
) -> str:
    """Segment a case or a volume file; what was found, for a person.

    Raises:
        VolumeError: a file cannot be read or used, or nothing is found.
        CaseError: the case cannot be read or changed.
    """
    if is_case(asked.case):
        if asked.out is not None:
            raise VolumeError(
                f"--out: {asked.case} is a case, which is changed in its place; leave --out away"
            )
        return _segment_case(asked, surfaces, progress)
    if asked.case.is_dir():
        raise CaseError(
            f"{asked.case}: is no case, as it has no case.yaml; `us-sim cases` lists some"
        )
    return _segment_file(asked, surfaces, progress)


def _segment_case(asked: SegmentRequest, surfaces: SurfaceSettings, progress: Progress) -> str:
    case = read_case(asked.case)
    progress(0.0, "reading")
    volume = case.volume() if _keeps_labels(asked) else read_volume(case.folder / "volume.nrrd")
    found = _found(asked, volume, progress)
    _with_structures(case.settings, found.labels, [])  # refuses a name before the rest is made
    made = _surfaces(found.labels.on(volume), surfaces, progress)
    remarks = list(found.labels.remarks)
    with changed_case(case.folder) as folder:
        case = read_case(folder)
        settings = _with_structures(case.settings, found.labels, remarks)
        if not _keeps_labels(asked):
            write_labels(folder / LABELS, found.labels.on(volume), found.labels.colours)
            if (folder / TISSUE).exists():
                (folder / TISSUE).unlink()
                remarks.append(f"{TISSUE} was made of other labels and is removed")
        write_case_settings(folder, settings)
        _write(folder, volume, found.labels, made, asked, remarks)
        for step in (found.step, _surface_step(made, surfaces)):
            add_step(folder, step)
        progress(1.0, "")
    return summary(asked.case, made, remarks)


def _segment_file(asked: SegmentRequest, surfaces: SurfaceSettings, progress: Progress) -> str:
    if not asked.case.exists():
        raise VolumeError(
            f"{asked.case}: there is no such case or volume file; `us-sim cases` lists cases"
        )
    if asked.out is None:
        raise VolumeError(
            f"{asked.case}: is a volume file, not a case: say with --out which folder to make"
        )
    if _keeps_labels(asked):
        raise VolumeError(
            f"{asked.case}: has no labels yet: give --labels, --seeds, or --vessels dark"
        )
    with new_folder(asked.out) as folder:
        progress(0.0, "reading")
        volume = read_volume(asked.case)
        found = _found(asked, volume, progress)
        made = _surfaces(found.labels.on(volume), surfaces, progress)
        remarks = list(found.labels.remarks)
        write_labels(folder / "labels.seg.nrrd", found.labels.on(volume), found.labels.colours)
        _write(folder, volume, found.labels, made, asked, remarks)
        progress(1.0, "")
    return summary(asked.out, made, remarks)


def _keeps_labels(asked: SegmentRequest) -> bool:
    return asked.labels is None and asked.seeds is None and asked.vessels is None


def _found(asked: SegmentRequest, volume: Volume, progress: Progress) -> _Found:
    """The labels that are asked for."""
    if asked.labels is not None:
        names = asked.given_names()
        labels = read_labels(
            asked.labels,
            volume,
            resample=asked.resample,
            table=asked.label_table,
            names=names,
            taken=RESERVED,
        )
        step = Step(
            "labels taken from a file",
            {"resample": asked.resample},
            _counts(labels),
            (Source.of(asked.labels, "labels"),),
        )
        return _Found(labels, step)
    if asked.seeds is not None:
        settings = read_seeds(_seeds_file(asked.seeds))
    elif asked.vessels is not None:
        settings = SegmentationSettings({"vessels": StructureSeeds(method=Chosen("dark_vessels"))})
    else:
        return _kept(volume)
    labels = segment(volume, settings, lambda done, what: progress(0.1 + 0.7 * done, what))
    return _Found(labels, Step("segmented", _said(settings), _counts(labels)))


def _kept(volume: Volume) -> _Found:
    """The labels that a case has."""
    names = {label: name for label, name in volume.label_names.items() if label}
    if volume.labels is None or not names:
        raise VolumeError(
            "the case has no labels yet: give --labels, --seeds, or --vessels dark to make some"
        )
    return _Found(LabelMap(volume.labels, names), Step("labels kept"))


def _seeds_file(path: Path) -> Path:
    """The file of seeds at that path, or the installed one of that name."""
    if not os.path.exists(path) and path.name == str(path):
        for root in shared_roots():
            installed = root / "config" / "seeds" / path.with_suffix(".yaml")
            if installed.is_file():
                return installed
    return path


def _said(settings: SegmentationSettings) -> dict[str, object]:
    """How structures were found; without the description, which is free text."""
    return {name: document_of(one) for name, one in settings.structures.items()}


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


def _surface_step(made: list[StructureSurface], settings: SurfaceSettings) -> Step:
    counts = {f"triangles of {one.name}": len(one.surface.triangles) for one in made}
    return Step("surfaces made", document_of(settings), counts)


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
    from us_sim.volume.segmentation.picture import draw_segmentation

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
        write_report(folder / REPORT, PICTURE, made, remarks)
