"""A case: a folder with everything that is needed to scan and press on one body part.

``case.yaml`` says what it is (`us_sim.volume.cases.settings`), ``volume.nrrd`` holds its grey
values and ``labels.nrrd`` on the same grid what each voxel is; ``surfaces/``, ``tissue.npz`` and
``provenance.yaml`` may be there. All names are these: a case names no files of its own choice.

>>> import tempfile
>>> import numpy as np
>>> from us_sim.volume.cases.case import read_case
>>> from us_sim.volume.cases.settings import CaseSettings
>>> from us_sim.volume.cases.writing import new_case, write_case_settings
>>> from us_sim.volume.files.writing import write_volume
>>> from us_sim.volume.volume import Volume
>>> block = Volume(np.ones((30, 20, 10), np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
>>> with tempfile.TemporaryDirectory() as root:
...     with new_case(f"{root}/block") as folder:
...         write_volume(folder / "volume.nrrd", block)
...         write_case_settings(folder, CaseSettings(name="block"))
...     case = read_case(f"{root}/block")
...     shape = case.volume().shape
>>> case.settings.name, shape
('block', (30, 20, 10))
"""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CaseError, VolumeError
from us_sim.settings.reading import Reader
from us_sim.settings.text_files import YamlError, load_yaml, read_text
from us_sim.volume.cases.provenance import PROVENANCE, Step, read_steps
from us_sim.volume.cases.settings import CaseSettings
from us_sim.volume.files.readers import open_image, read_placement, read_volume
from us_sim.volume.volume import Volume

CASE = "case.yaml"
VOLUME = "volume.nrrd"
LABELS = "labels.nrrd"
SURFACES = "surfaces"
TISSUE = "tissue.npz"

_SAME_PLACE = 1e-6
"""m, by which two grids may differ at their corners and still be one."""


@dataclass(frozen=True, eq=False)
class Case:
    """An opened case; its volume is read when it is asked for."""

    folder: Path
    settings: CaseSettings
    steps: tuple[Step, ...]  # what was done to make it

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
            _check_inside(self.folder, f"{SURFACES}/{file.name}")
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
        there = np.bincount(labels.reshape(-1), minlength=256) > 0
        for label in np.flatnonzero(there):
            if int(label) not in self.settings.label_names:
                raise CaseError(
                    f"{self.folder / LABELS}: has the label {label}, which is no structure in "
                    f"{CASE}: name it there"
                )
        for name, structure in self.settings.structures.items():
            if not there[structure.label]:
                raise CaseError(
                    f"{self.folder / CASE}: structures.{name}: label {structure.label} occurs "
                    f"nowhere in {LABELS}: segment it, or remove the structure"
                )
        names = self.settings.label_names
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
                f"{self.folder / LABELS}: its labels are not 8-bit numbers: use 0 to 255, saved "
                f"as unsigned char"
            )
        last = np.array([*(np.array(shape) - 1.0), 1.0])
        corners = np.array([[0.0, 0.0, 0.0, 1.0], last, [last[0], 0, 0, 1], [0, last[1], 0, 1]])
        apart = np.abs((placement - of_labels) @ corners.T).max()
        if shape != other or apart > _SAME_PLACE:
            raise CaseError(
                f"{self.folder / LABELS}: is on another grid than {VOLUME} "
                f"({' × '.join(map(str, other))} voxels, {' × '.join(map(str, shape))} there, up "
                f"to {apart * 1e3:.3g} mm apart): segment this volume, or resample the labels"
            )


def is_case(folder: str | os.PathLike[str]) -> bool:
    """Whether a folder has a ``case.yaml``; a link that leads nowhere or in a circle has none."""
    return os.path.isfile(Path(folder) / CASE)


def read_case(folder: str | os.PathLike[str]) -> Case:
    """The case in a folder; of its volume nothing but the name is looked at.

    Raises:
        CaseError: there is none, a file of it leads out of the folder or in a circle, or what it
            says cannot be used.
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
    for name in (CASE, VOLUME, LABELS, SURFACES, TISSUE, PROVENANCE):
        _check_inside(folder, name)
    for name in (CASE, VOLUME):
        if not (folder / name).is_file():
            raise CaseError(f"{folder}: is no case, as it has no {name}; `us-sim cases` lists some")
    return Case(folder, _settings(folder / CASE), read_steps(folder))


def _check_inside(folder: Path, name: str) -> None:
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
            f"{path}: is a link that leads out of the case, nowhere, or in a circle: put the file "
            f"itself there"
        )


def _settings(path: Path) -> CaseSettings:
    try:
        document = load_yaml(read_text(path))
    except (OSError, UnicodeDecodeError) as error:
        raise CaseError(f"{path}: cannot be read: {error}") from error
    except YamlError as error:
        raise CaseError(f"{path}: {error}") from error
    if document is None:
        raise CaseError(f"{path}: is empty; a case has at least a name")
    return Reader(str(path), None, CaseError).read(CaseSettings, document)


def _placement(path: Path) -> tuple[NDArray[np.float64], tuple[int, int, int]]:
    image = open_image(path)
    if image.voxels.file != path:
        raise VolumeError(
            f"{path}: keeps its voxels in another file, which a case must not: save it as one file"
        )
    return read_placement(path), image.shape
