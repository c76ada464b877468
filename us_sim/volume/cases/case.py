"""A case: a folder with everything that is needed to scan and press on one body part.

``case.yaml`` says what it is (`us_sim.volume.cases.settings`), ``volume.nrrd`` holds its grey
values and ``labels.nrrd`` on the same grid what each voxel is; ``surfaces/``, ``tissue.npz`` and
``provenance.yaml`` may be there. All names are these: a case names no files of its own choice.

Folders of cases are those in the environment variable US_SIM_CASES, or the folder ``cases`` in the
user's data folder. A case is named by its folder in one of them, or by its path.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from numpy.typing import NDArray

from us_sim.errors import CaseError, UsSimError, VolumeError
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.reading import Reader
from us_sim.settings.registry import PROBES
from us_sim.settings.spelling import aligned, nearest, unknown
from us_sim.settings.text_files import read_yaml
from us_sim.volume.cases.provenance import PROVENANCE, Step, read_steps
from us_sim.volume.cases.settings import CaseSettings
from us_sim.volume.files.readers import open_image, read_placement, read_volume
from us_sim.volume.volume import Volume

CASE = "case.yaml"
VOLUME = "volume.nrrd"
LABELS = "labels.nrrd"
SURFACES = "surfaces"
TISSUE = "tissue.npz"


@dataclass(frozen=True, eq=False)
class Case:
    """An opened case; its volume is read when it is asked for."""

    folder: Path
    settings: CaseSettings
    steps: tuple[Step, ...]  # how it was made
    shown: Path  # the folder that errors name

    @property
    def has_labels(self) -> bool:
        """Whether it is segmented."""
        return (self.folder / LABELS).is_file()

    @property
    def surfaces(self) -> dict[str, Path]:
        """Files of surfaces, by the names of their structures."""
        folder = self.folder / SURFACES
        if not folder.is_dir():
            return {}
        for file in folder.iterdir():
            _check_inside(self.folder, f"{SURFACES}/{file.name}", self.shown)
        return {file.stem: file for file in sorted(folder.iterdir()) if file.is_file()}

    @property
    def tissue(self) -> Path | None:
        """The file of its tissue, where that has been made."""
        file = self.folder / TISSUE
        return file if file.is_file() else None

    def placement(self) -> tuple[NDArray[np.float64], tuple[int, int, int]]:
        """Where its voxels are, from the header alone: (4, 4) m from indices, and the shape.

        Raises:
            VolumeError: the header cannot be used.
        """
        return _placement(self.folder / VOLUME)

    def volume(self) -> Volume:
        """Grey values in the volume's own frame, with labels and their names where it has some.

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
        there = np.bincount(labels.reshape(-1), minlength=256) > 0
        for label in np.flatnonzero(there):
            if int(label) not in names:
                raise CaseError(
                    f"{self.shown / LABELS}: has the label {label}, which is no structure in "
                    f"{CASE}: name it there"
                )
        for name, structure in self.settings.structures.items():
            if not there[structure.label]:
                raise CaseError(
                    f"{self.shown / CASE}: structures.{name}: label {structure.label} occurs "
                    f"nowhere in {LABELS}: segment it, or remove the structure"
                )
        return dataclasses.replace(volume, labels=labels, label_names=names)

    def check_grids(self) -> None:
        """Compare the grid of the labels with the volume's, by their headers.

        Raises:
            CaseError: they differ, or the labels are not 8-bit.
            VolumeError: a header cannot be used.
        """
        placement, shape = self.placement()
        of_labels, other = _placement(self.folder / LABELS)
        if open_image(self.folder / LABELS).voxels.type.itemsize != 1:
            raise CaseError(
                f"{self.shown / LABELS}: its labels are not 8-bit numbers: use 0 to 255, saved "
                f"as unsigned char"
            )
        last = np.array([*(np.array(shape) - 1.0), 1.0])
        corners = np.array([[0.0, 0.0, 0.0, 1.0], last, [last[0], 0, 0, 1], [0, last[1], 0, 1]])
        apart = np.abs((placement - of_labels) @ corners.T).max()  # m
        if shape != other or apart > 1e-6:
            raise CaseError(
                f"{self.shown / LABELS}: is on another grid than {VOLUME} "
                f"({' × '.join(map(str, other))} voxels, {' × '.join(map(str, shape))} there, up "
                f"to {apart * 1e3:.3g} mm apart): segment this volume, or resample the labels"
            )


def is_case(folder: str | os.PathLike[str]) -> bool:
    """Whether a folder has a ``case.yaml``; a link that leads nowhere or in a circle has none."""
    return os.path.isfile(Path(folder) / CASE)


def read_case(folder: str | os.PathLike[str], shown: Path | None = None) -> Case:
    """The case in a folder; its volume is not opened.

    Args:
        folder: of the case.
        shown: the folder that errors name, where the case is about to be moved there.

    Raises:
        CaseError: there is none, a file of it leads out of the folder or in a circle, or its
            settings cannot be used.
    """
    folder = Path(folder)
    try:
        folder = folder.resolve(strict=True)
    except FileNotFoundError:
        left = sorted(folder.parent.glob(f".{folder.name}.before-*")) if folder.name else []
        hint = f"; a change of it was broken off: rename {left[0].name} to it" if left else ""
        raise CaseError(f"{folder}: there is no such case{hint}") from None
    except (OSError, RuntimeError) as error:
        raise CaseError(
            f"{folder}: cannot be opened; its links may lead in a circle: "
            f"{getattr(error, 'strerror', None) or error}"
        ) from error
    shown = shown or folder
    for name in (CASE, VOLUME, LABELS, SURFACES, TISSUE, PROVENANCE):
        _check_inside(folder, name, shown)
    for name in (CASE, VOLUME):
        if not (folder / name).is_file():
            raise CaseError(f"{shown}: is no case, as it has no {name}; `us-sim cases` lists some")
    path = shown / CASE
    document = read_yaml(folder / CASE, CaseError, path)
    if document is None:
        raise CaseError(f"{path}: is empty; a case has at least a name")
    settings = Reader(str(path), None, CaseError).read(CaseSettings, document)
    return Case(folder, settings, read_steps(folder), shown)


def _check_inside(folder: Path, name: str, shown: Path) -> None:
    """Refuse a link that leads elsewhere: a case may come from a stranger."""
    path = folder / name
    if not path.is_symlink():
        return
    try:
        inside = path.resolve(strict=True).is_relative_to(folder)
    except (OSError, RuntimeError):
        inside = False
    if not inside:
        raise CaseError(
            f"{shown / name}: is a link that leads out of the case, nowhere, or in a circle: put "
            f"the file itself there"
        )


def _placement(path: Path) -> tuple[NDArray[np.float64], tuple[int, int, int]]:
    image = open_image(path)
    if image.voxels.file != path:
        raise VolumeError(
            f"{path}: keeps its voxels in another file, which a case must not: save it as one file"
        )
    return read_placement(path), image.shape


def case_roots() -> list[Path]:
    """Folders of cases; the first of them goes before the others where a name is in several."""
    given = os.environ.get("US_SIM_CASES", "")
    roots = [Path(os.path.expanduser(part)) for part in given.split(os.pathsep) if part]
    return roots or [platformdirs.user_data_path("us_sim") / "cases"]


def cases_in(root: Path) -> list[Path]:
    """The folders in a folder that have a ``case.yaml``, by name; itself where it is a case.

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
    """The folder of a case, by its path or by its name in one of `case_roots`.

    Args:
        name: of the case, or its folder.
        folders: where a relative path begins; the current folder is the last of them.

    Raises:
        CaseError: there is none; the sentence says which there are.
    """
    path = Path(os.path.expanduser(name))
    places = [folder / path for folder in (*folders, Path.cwd())] if str(name) else []
    for place in places:
        if is_case(place):
            return place.resolve()
    roots = case_roots()
    known: dict[str, Path] = {}
    for root in roots:
        for case in cases_in(root) if root.is_dir() else []:
            known.setdefault(case.name, case)
    if str(name) in known:
        return known[str(name)].resolve()
    for place in places:
        if place.exists():
            kind = f"folder without a {CASE}" if place.is_dir() else "file"
            raise CaseError(f"{name}: is a {kind}, and there is no case of that name")
    for folder in {place.parent for place in places} if path.name != str(path) else ():
        beside = [path.with_name(case.name) for case in cases_in(folder)] if folder.is_dir() else []
        if beside:
            raise CaseError(f"there is no such case: {unknown(str(path), map(str, beside))}")
    like = nearest(name, known)
    there = f"cases are {', '.join(known)}" if known else "there is none"
    raise CaseError(
        f"there is no case {name}; {there} in {', '.join(map(str, roots))}"
        + (f"; did you mean {like}?" if like else "")
    )


@dataclass(frozen=True)
class ListedCase:
    """A line of a list of cases."""

    folder: Path
    name: str
    region: str = ""
    probe: str = ""
    size: str = ""
    structures: str = ""
    problem: str = ""  # why it cannot be used


def listed(folder: Path) -> ListedCase:
    """The facts of the case in a folder, from its texts and headers alone."""
    try:
        case = read_case(folder)
        matrix, shape = case.placement()
        if case.has_labels:
            case.check_grids()
    except UsSimError as error:
        return ListedCase(folder, folder.name, problem=str(error))
    voxel = np.linalg.norm(matrix[:3, :3], axis=0) * 1e3
    extent = " × ".join(f"{length:.0f}" for length in voxel * shape)
    sides = sorted({f"{side:.2g}" for side in voxel})
    settings = case.settings
    return ListedCase(
        folder,
        folder.name,
        settings.region or settings.name,
        _probe(settings.probe),
        f"{extent} mm, voxels of {' and '.join(sides)} mm",
        ", ".join(settings.structures) if case.has_labels else "not segmented",
    )


def table(cases: Sequence[ListedCase]) -> str:
    """The cases in columns, and under them the problems of those that cannot be used."""
    good = [case for case in cases if not case.problem]
    titles = ("case", "region", "probe", "size", "structures")
    rows = [titles, *((c.name, c.region, c.probe, c.size, c.structures) for c in good)]
    cut = [[text if len(text) <= 60 else f"{text[:60]}..." for text in row] for row in rows]
    lines = aligned(cut, left=range(len(titles))) if good else []
    return "\n".join(
        [*lines, *(f"cannot be used: {case.problem}" for case in cases if case.problem)]
    )


def _probe(probe: ProbeSettings | None) -> str:
    if probe is None:
        return ""
    array: Any = probe.array.settings(PROBES)
    return f"{probe.geometry}, {array.depth * 1e3:.0f} mm deep"
