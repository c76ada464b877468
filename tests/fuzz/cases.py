"""The files of a case: what it says, what was done, its volume, its labels and its tissue."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests.fuzz.target import target
from us_sim.scene.reading import load_scene
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.cases.case import read_case
from us_sim.volume.cases.provenance import Source, Step, add_step
from us_sim.volume.cases.settings import AROUND, CaseSettings, CaseStructure
from us_sim.volume.cases.tissue import CaseTissue, read_tissue, write_tissue
from us_sim.volume.cases.writing import new_case, write_case_settings
from us_sim.volume.files.writing import write_labels, write_volume
from us_sim.volume.volume import Volume

STRUCTURES = {"vein": CaseStructure(3), "rib": CaseStructure(4, colour=(0.9, 0.9, 0.8))}


@functools.cache
def whole() -> dict[str, bytes]:
    """The files of a whole case of 2,500 voxels."""
    labels = np.zeros((12, 14, 15), np.uint8)
    labels[4:7, :, 5:8], labels[:, :, 13:] = 3, 4
    volume = Volume(
        np.where(labels == 3, 10, 90).astype(np.uint8), np.diag([3e-3] * 3 + [1.0]), labels
    )
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "case"
        with new_case(made) as partial:
            write_volume(partial / "volume.nrrd", volume)
            write_labels(partial / "labels.nrrd", volume)
            write_case_settings(partial, CaseSettings("case", "arm", structures=STRUCTURES))
            source = Source("volume", 64 * "a")
            add_step(partial, Step("imported", {"spacing": 1e-3}, {"files": 1}, (source,)))
        return {file.name: file.read_bytes() for file in made.iterdir()}


def with_changed(path: Path, name: str) -> None:
    """A case of which one file is the changed one, made a scene and its volume."""
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        case = Path(folder) / "case"
        case.mkdir()
        for file, content in (whole() | {name: path.read_bytes()}).items():
            (case / file).write_bytes(content)
        read = read_case(case)
        volume = read.volume()
        assert volume.labels is None or set(np.unique(volume.labels)) <= set(volume.label_names)
        scene = load_scene(f"case:{case}")
        assert scene.tissue is not None
        assert AROUND in scene.tissue.materials


def seeds_of(name: str):  # type: ignore[no-untyped-def]
    """Makes the whole file of that name."""

    def seeds(_: Path) -> Iterator[bytes]:
        yield whole()[name]

    return seeds


@target("case", ".yaml", seeds_of("case.yaml"))
def case(path: Path) -> None:
    """A changed ``case.yaml``."""
    with_changed(path, "case.yaml")


@target("case-labels", ".nrrd", seeds_of("labels.nrrd"))
def labels_of_case(path: Path) -> None:
    """Changed labels."""
    with_changed(path, "labels.nrrd")


@target("case-volume", ".nrrd", seeds_of("volume.nrrd"))
def volume_of_case(path: Path) -> None:
    """A changed volume."""
    with_changed(path, "volume.nrrd")


@target("provenance", ".yaml", seeds_of("provenance.yaml"))
def provenance(path: Path) -> None:
    """A changed ``provenance.yaml``."""
    with_changed(path, "provenance.yaml")


def tissue_seeds(folder: Path) -> Iterator[bytes]:
    """A box, packed and not."""
    mesh = box_mesh([0.0, 0.01, 0.03], [0.0, 0.01], [0.0, 0.02])
    fractions = np.full((len(mesh.tetrahedra), 2), 0.5)
    file = folder / "tissue.npz"
    write_tissue(file, CaseTissue(mesh, np.array([0, 3], np.uint8), fractions, {"nodes": 12}))
    yield file.read_bytes()
    with np.load(file) as stored:
        np.savez_compressed(file, **{name: stored[name] for name in stored.files})
    yield file.read_bytes()


@target("tissue", ".npz", tissue_seeds)
def tissue(path: Path) -> None:
    """A mesh and what is in it."""
    read = read_tissue(path)
    assert read.fractions.shape == (len(read.mesh.tetrahedra), len(read.labels))
    assert np.isfinite(read.fractions).all()
