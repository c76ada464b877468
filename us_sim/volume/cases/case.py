"""A case: a folder with everything that is needed to scan and press on one body part.

``case.yaml`` says what it is (`us_sim.volume.cases.settings`), ``volume.nrrd`` holds its grey
values and ``labels.nrrd`` on the same grid what each voxel is; ``surfaces/`` may be
there. All names are these: a case names no files of its own choice.

Folders of cases are those in the environment variable US_SIM_CASES, or the folder ``cases`` in the
user's data folder. A case is named by its folder in one of them, or by its path.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import platformdirs
from numpy.typing import NDArray

from us_sim.errors import CaseError, UsSimError
from us_sim.settings.reading import SettingsReader
from us_sim.settings.registry import PROBES
from us_sim.settings.spelling import align_columns, describe_unknown
from us_sim.settings.text_files import read_yaml
from us_sim.volume.cases.settings import CaseSettings
from us_sim.volume.files.readers import open_image, read_placement, read_volume
from us_sim.volume.volume import Volume

CASE = "case.yaml"
VOLUME = "volume.nrrd"
LABELS = "labels.nrrd"
SURFACES = "surfaces"


@dataclass(frozen=True, eq=False)
class Case:
    """An opened case; its volume is read when it is asked for."""

    folder: Path
    settings: CaseSettings

    @property
    def has_labels(self) -> bool:
        """Tell whether it is segmented."""
        return (self.folder / LABELS).is_file()

    def read_placement(self) -> tuple[NDArray[np.float64], tuple[int, int, int]]:
        """Read where its voxels are from the header alone: (4, 4) m from indices, and the shape.

        Raises:
            VolumeError: the header cannot be used.
        """
        path = self.folder / VOLUME
        return read_placement(path), open_image(path).shape

    def read_volume(self) -> Volume:
        """Read grey values in the volume's own frame, and labels and their names if there are any.

        Raises:
            CaseError: the labels are on another grid or are no whole numbers from 0 to 255, one of
                them is no structure, or a structure occurs nowhere.
            VolumeError: a file cannot be read.
        """
        volume = read_volume(self.folder / VOLUME)
        if not self.has_labels:
            return volume
        self.check_grids()
        labels = read_volume(self.folder / LABELS).intensities
        names = self.settings.label_names
        there = {int(label) for label in np.unique(labels)}
        for label in sorted(there - set(names)):
            raise CaseError(
                f"{self.folder / LABELS}: has the label {label}, which is no structure in {CASE}: "
                f"name it there"
            )
        for label in sorted(set(names) - there - {0}):
            raise CaseError(
                f"{self.folder / CASE}: structures.{names[label]}: label {label} occurs nowhere in "
                f"{LABELS}: segment it, or remove the structure"
            )
        return dataclasses.replace(volume, labels=labels, label_names=names)

    def check_grids(self) -> tuple[NDArray[np.float64], tuple[int, int, int]]:
        """Compare the grid of labels that there are with the volume's, which is returned.

        Nothing but headers is read; see `read_placement`.

        Raises:
            CaseError: they differ, or the labels are not 8-bit.
            VolumeError: a header cannot be used.
        """
        placement, shape = self.read_placement()
        if not self.has_labels:
            return placement, shape
        labels = open_image(self.folder / LABELS)
        if labels.type.itemsize != 1:
            raise CaseError(
                f"{self.folder / LABELS}: its labels are not 8-bit numbers: use 0 to 255, saved "
                f"as unsigned char"
            )
        # m, by which no voxel is farther off along an axis
        away = (np.abs(placement - labels.placement()) @ [*shape, 1.0]).max()
        if shape != labels.shape or away > 1e-6:
            raise CaseError(
                f"{self.folder / LABELS}: is on another grid than {VOLUME} "
                f"({' × '.join(map(str, labels.shape))} voxels, {' × '.join(map(str, shape))} "
                f"there, up to {away * 1e3:.3g} mm apart): segment this volume, or "
                f"resample the labels"
            )
        return placement, shape


def is_case(folder: str | os.PathLike[str]) -> bool:
    """Tell whether a folder has a ``case.yaml``; a link that leads nowhere has none."""
    return os.path.isfile(Path(folder) / CASE)


def read_case(folder: str | os.PathLike[str]) -> Case:
    """Read the case in a folder; its volume is not opened.

    Raises:
        CaseError: there is none, or its settings cannot be used.
    """
    folder = Path(folder)
    if not folder.exists():
        raise CaseError(f"{folder}: there is no such case; `us-sim cases` lists some")
    folder = folder.resolve()
    for name in (CASE, VOLUME):
        if not (folder / name).is_file():
            raise CaseError(f"{folder}: is no case, as it has no {name}; `us-sim cases` lists some")
    path = folder / CASE
    document = read_yaml(path, CaseError)
    if document is None:
        raise CaseError(f"{path}: is empty; a case has at least a name")
    return Case(folder, SettingsReader(str(path), None, CaseError).read(CaseSettings, document))


def list_case_roots() -> list[Path]:
    """Return folders of cases; of several that have a name the first is taken."""
    given = os.environ.get("US_SIM_CASES", "")
    roots = [Path(os.path.expanduser(part)) for part in given.split(os.pathsep) if part]
    return roots or [platformdirs.user_data_path("us_sim") / "cases"]


def find_cases(root: Path) -> list[Path]:
    """Return the folders in a folder that have a ``case.yaml``, by name; itself where it is a case.

    Raises:
        CaseError: there is no such folder, or it cannot be read.
    """
    if is_case(root):
        return [root]
    try:
        inside = sorted(path for path in root.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise CaseError(f"{root}: cannot be read: {error.strerror}") from error
    return [path for path in inside if is_case(path)]


def find_case(name: str | os.PathLike[str], folders: Sequence[Path] = ()) -> Path:
    """Find the folder of a case, by its path or by its name in one of `list_case_roots`.

    A relative path begins in one of ``folders``, the last of which is the current one.

    Raises:
        CaseError: there is none; the sentence says which there are.
    """
    path = Path(os.path.expanduser(name))
    places = [folder / path for folder in (*folders, Path.cwd())] if str(name) else []
    roots = [root for root in list_case_roots() if root.is_dir()]
    named = {case.name: case for root in reversed(roots) for case in find_cases(root)}
    for case in (*filter(is_case, places), *([named[str(name)]] if str(name) in named else [])):
        return case.resolve()
    if any(place.exists() for place in places):
        raise CaseError(f"{name}: is no case, as it has no {CASE}; `us-sim cases` lists some")
    if not named:
        where = ", ".join(map(str, list_case_roots()))
        raise CaseError(f"there is no case {name}, and none at all in {where}")
    raise CaseError(f"there is no such case: {describe_unknown(str(name), sorted(named))}")


class ListedCase(NamedTuple):
    """A line of a list of cases."""

    name: str
    region: str = ""
    probe: str = ""
    size: str = ""
    structures: str = ""
    problem: str = ""  # why it cannot be used


def list_case(folder: Path) -> ListedCase:
    """Collect the facts of the case in a folder, from its texts and headers alone."""
    try:
        case = read_case(folder)
        matrix, shape = case.check_grids()
    except UsSimError as error:
        return ListedCase(folder.name, problem=str(error))
    voxel = np.linalg.norm(matrix[:3, :3], axis=0) * 1e3
    extent = " × ".join(f"{length:.0f}" for length in voxel * shape)
    sides = sorted({f"{side:.2g}" for side in voxel})
    settings, shown = case.settings, ""
    if settings.probe is not None:
        array: Any = settings.probe.array.resolve_settings(PROBES)
        shown = f"{settings.probe.geometry}, {array.depth * 1e3:.0f} mm deep"
    return ListedCase(
        folder.name,
        settings.region or settings.name,
        shown,
        f"{extent} mm, voxels of {' and '.join(sides)} mm",
        ", ".join(settings.structures) if case.has_labels else "not segmented",
    )


def format_cases(cases: Sequence[ListedCase]) -> str:
    """Lay out cases in columns, and under them the problems of those that cannot be used."""
    rows = [case[:-1] for case in cases if not case.problem]
    titles = ("case", "region", "probe", "size", "structures")
    cut = [[text if len(text) <= 60 else f"{text[:60]}..." for text in row] for row in rows]
    lines = align_columns([titles, *cut], left=range(len(titles))) if rows else []
    return "\n".join(
        [*lines, *(f"cannot be used: {case.problem}" for case in cases if case.problem)]
    )
