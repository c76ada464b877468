"""Transforms of 3D Slicer: single files (`.h5`, `.tfm`), and sequences of them in its scenes.

Slicer writes transforms through ITK, which stores the way from the parent to the child, in LPS and
millimetres. Returned is the matrix that Slicer itself shows: to the parent, in RAS.

A sequence of transforms is a bundle (`.mrb`); its times are in the scene (`.mrml`) that names it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.sequences import itk_reader
from us_sim.volume.sequences.transforms import FrameTransforms, in_metres, split_transform_name

SLICER_SCENES = (".mrb", ".mrml")
SLICER_TRANSFORMS = (".h5", ".hdf5", ".tfm")
_TO_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
_LARGEST = 1 << 28  # bytes that are unpacked of a bundle
_MOST = 100_000  # transforms


def read_slicer_transform(path: str | Path) -> NDArray[np.float64]:
    """The transform (4, 4) of a file, m, to the parent in RAS; named by its file.

    Raises:
        VolumeError: it cannot be read, or holds none that is linear in 3D.
    """
    path = Path(path)
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise VolumeError(f"{path}: cannot be read: {error.strerror}") from None
    return in_metres(path.stem, _to_parent([(path, str(path))]))[0]


def read_slicer_sequences(
    path: str | Path,
) -> tuple[NDArray[np.float64], dict[str, FrameTransforms]]:
    """The sequences of transforms in a scene (`.mrml`), or in a bundle (`.mrb`) that one beside it
    names.

    Transforms of the scene that stand still are there at every time.

    Returns:
        Times (K,) in s, rising, and the transforms at them, m, by name; one that is not named
        ``AToB`` is of its name to ``RAS``.

    Raises:
        VolumeError: it cannot be read, holds no sequence of transforms, or no times are known.
    """
    path = Path(path)
    try:
        scene, only = _opened(path)
        return _read(path, scene, only)
    except (OSError, zipfile.BadZipFile, KeyError, NotImplementedError, RuntimeError) as error:
        why = getattr(error, "strerror", None) or str(error).strip("'\"")
        raise VolumeError(f"{path}: cannot be read as a scene of 3D Slicer: {why}") from None
    except (ElementTree.ParseError, UnicodeDecodeError, ValueError) as error:
        raise VolumeError(f"{path}: its scene cannot be understood: {error}") from None


class _Scene:
    """The nodes of a scene, by their ids, and the files that lie beside it."""

    def __init__(self, text: bytes, beside: Path | _Bundle) -> None:
        # Entities that expand without end are a known attack; no scene needs any.
        if b"<!ENTITY" in text:
            raise ValueError("it defines entities, which is not allowed")
        self._beside = beside
        self.nodes: dict[str, ElementTree.Element] = {}
        for element in ElementTree.fromstring(text).iter():
            self.nodes.setdefault(element.get("id", ""), element)

    def of(self, tag: str) -> Iterator[ElementTree.Element]:
        """The nodes of a kind."""
        return (node for node in self.nodes.values() if node.tag == tag)

    def file_of(self, node: ElementTree.Element) -> str:
        """The name of the file in which a node is stored; empty where it has none."""
        storage = self.nodes.get(node.get("storageNodeRef", ""))
        return unquote(storage.get("fileName", "")) if storage is not None else ""

    def read(self, name: str) -> bytes:
        """A file beside the scene."""
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ValueError(f"it names {name!r}, which does not lie beside it")
        if isinstance(self._beside, _Bundle):
            return self._beside.read(name)
        return (self._beside / name).read_bytes()


class _Bundle:
    """A zip file with a scene in it."""

    def __init__(self, data: bytes) -> None:
        self._zip = zipfile.ZipFile(BytesIO(data))
        if sum(entry.file_size for entry in self._zip.infolist()) > _LARGEST:
            raise ValueError(f"it holds more than {_LARGEST} bytes: export a part of it")
        names = [name for name in self._zip.namelist() if name.lower().endswith(".mrml")]
        if not names:
            raise ValueError("it holds no .mrml")
        main = PurePosixPath(min(names, key=len))
        self._folder = main.parent
        self.scene = _Scene(self._zip.read(str(main)), self)

    def read(self, name: str) -> bytes:
        return self._zip.read(str(self._folder / name))


def _opened(path: Path) -> tuple[_Scene, str]:
    """The scene with the times, and the only file of a sequence that is meant, if any."""
    data = path.read_bytes()
    if path.suffix.lower() == ".mrml":
        return _Scene(data, path.parent), ""
    scene = _Bundle(data).scene
    if any(scene.of("Sequence")):
        return scene, ""
    for file in sorted(path.parent.glob("*.mrml")):
        beside = _Scene(file.read_bytes(), path.parent)
        if any(beside.file_of(node) == path.name for node in beside.of("Sequence")):
            return beside, path.name
    raise ValueError(
        "it holds transforms without times, which Slicer keeps in the scene's .mrml: put that "
        "beside it, or give it"
    )


def _read(
    path: Path, scene: _Scene, only: str
) -> tuple[NDArray[np.float64], dict[str, FrameTransforms]]:
    moving: dict[str, list[tuple[float, bytes, str]]] = {}
    for sequence in scene.of("Sequence"):
        file = scene.file_of(sequence)
        if not file.lower().endswith(".mrb") or only not in ("", file):
            continue
        stored = _Bundle(scene.read(file)).scene
        for entry in filter(None, sequence.get("indexValues", "").split(";")):
            identity, _, time = entry.partition(":")
            node = stored.nodes.get(identity)
            if node is None or node.tag != "LinearTransform":
                continue
            name = _name(sequence.get("name", "").removesuffix("-Sequence"))
            data = stored.read(stored.file_of(node))
            moving.setdefault(name, []).append((float(time), data, stored.file_of(node)))
    if not moving:
        raise ValueError("it holds no sequence of linear transforms")
    still = {
        _name(node.get("name", "")): (scene.read(scene.file_of(node)), scene.file_of(node))
        for node in scene.of("LinearTransform")
        if scene.file_of(node).lower().endswith(SLICER_TRANSFORMS)
        and _name(node.get("name", "")) not in moving
        and not only
    }
    files = [(data, file) for series in moving.values() for _, data, file in series]
    files += still.values()
    matrices = iter(_stored(path, files))
    times = np.unique([time for series in moving.values() for time, *_ in series])
    found = {}
    for name, series in moving.items():
        placed = np.full((len(times), 4, 4), np.nan)
        for when, *_ in series:
            placed[np.searchsorted(times, when)] = next(matrices)
        seen = np.isfinite(placed[:, 0, 0])
        faults = tuple("" if each else "no transform at its time" for each in seen)
        found[name] = FrameTransforms(in_metres(name, placed), faults)
    for name in still:
        placed = np.broadcast_to(in_metres(name, next(matrices)), (len(times), 4, 4))
        found[name] = FrameTransforms(placed, ("",) * len(times))
    return times, found


def _name(name: str) -> str:
    """Of a transform that leads from one frame to another."""
    if split_transform_name(name) or not name:
        return name
    return f"{name[0].upper()}{name[1:]}ToRAS"


def _stored(path: Path, files: Sequence[tuple[bytes, str]]) -> NDArray[np.float64]:
    """Transforms (N, 4, 4), mm, to their parents, of files in memory with their names."""
    if len(files) > _MOST:
        raise ValueError(f"it holds {len(files)} transforms, of which {_MOST} are read at most")
    with tempfile.TemporaryDirectory() as folder:
        placed = []
        for number, (data, name) in enumerate(files):
            file = Path(folder, f"{number}{PurePosixPath(name).suffix}")
            file.write_bytes(data)
            placed.append((file, f"{path}: {name}"))
        return _to_parent(placed)


def _to_parent(files: Sequence[tuple[Path, str]]) -> NDArray[np.float64]:
    """Transforms (N, 4, 4), mm, of files, each with its name in errors."""
    # -P: this folder is no place to import from.
    command = [sys.executable, "-P", str(Path(itk_reader.__file__))]
    task = json.dumps([str(file.resolve()) for file, _ in files]).encode()
    label = files[0][1]
    try:
        done = subprocess.run(command, input=task, capture_output=True, timeout=180.0)
        rows = json.loads(done.stdout)
    except (subprocess.TimeoutExpired, ValueError):  # the file has ended what reads it
        raise VolumeError(f"{label}: is damaged, or no transform of ITK: export it again") from None
    for (_, label), row in zip(files, rows, strict=True):
        if isinstance(row, str):
            raise VolumeError(f"{label}: {row}; export a linear transform from 3D Slicer")
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    matrices[:, :3] = np.array(rows, dtype=np.float64).reshape(-1, 3, 4)
    try:
        return np.asarray(_TO_LPS @ np.linalg.inv(matrices) @ _TO_LPS)
    except np.linalg.LinAlgError:
        raise VolumeError(f"{label}: a transform has no inverse: export it again") from None
