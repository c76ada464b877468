"""Attachments of a recording: its scene, the files that the scene names, and versions."""

from __future__ import annotations

import dataclasses
import hashlib
import mimetypes
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from us_sim.errors import BagError, UsSimError
from us_sim.nodes.settings import SessionRecorderSettings
from us_sim.recording.attached_files import list_versions
from us_sim.recording.storage import find_bag_files
from us_sim.scene.reading import parse_scene, read_scene_document, with_path, with_volume
from us_sim.settings.setting import rules_of
from us_sim.share import full_path

LARGEST = 4 * 1024 * 1024
"""Bytes of a file that is attached; of larger files, such as volumes, only the checksum is."""


def collect_attachments(settings: SessionRecorderSettings) -> dict[str, tuple[str, bytes]]:
    """Collect media types and contents by file names.

    ``scene.yaml`` is the scene with all that it is based on. It names attached files as they are
    extracted beside it, and others by their paths, which `files.txt` lists with their checksums.
    """
    attached = {"versions.txt": ("text/plain", list_versions().encode())}
    if settings.parameters:
        attached["parameters.yaml"] = "application/yaml", settings.parameters.encode()
    listed: dict[Path, str] = {}  # checksums
    for name in settings.attach:
        path = full_path(name)
        try:
            is_large = path.stat().st_size > LARGEST
        except OSError as error:
            raise BagError(f"{name} cannot be attached: {error.strerror}") from None
        if not path.is_file():
            raise BagError(f"{path} cannot be attached: it is no file")
        if is_large:
            listed[path] = file_checksum(path)
        else:
            _attach(attached, path)
    if settings.scene is not None:
        listed |= _attach_scene(attached, settings)
    if listed:
        lines = [f"{checksum}  {path}\n" for path, checksum in sorted(listed.items())]
        attached["files.txt"] = "text/plain", "".join(lines).encode()
    return attached


def _attach_scene(
    attached: dict[str, tuple[str, bytes]], settings: SessionRecorderSettings
) -> dict[Path, str]:
    """Attach a scene and its small files; return the checksums of all its files."""
    document, folders, origin = read_scene_document(str(settings.scene))
    if settings.volume:
        document = with_volume(document, settings.volume)
    if settings.path:
        document = with_path(document, settings.path)
    listed: dict[Path, str] = {}
    places = {}
    scene = parse_scene(document, origin=origin, folders=folders)
    for path in sorted(set(_files(scene))):
        parts = find_files(path)
        small = sum(part.stat().st_size for part in parts if part.is_file()) <= LARGEST
        whole = small and all(
            part.is_file() and _attach(attached, part, str(part.relative_to(path.parent)))
            for part in parts
        )
        places[path] = path.name if whole else str(path)
        listed |= {part: file_checksum(part) for part in parts}
    text = yaml.safe_dump(_placed(document, places), sort_keys=False, allow_unicode=True)
    attached["scene.yaml"] = "application/yaml", text.encode()
    return listed


def find_files(path: Path) -> list[Path]:
    """Find the files of a bag, a case, a series of DICOM or another folder; or the file itself."""
    if not path.is_dir():
        return [path]
    try:
        return find_bag_files(path)
    except (BagError, OSError):
        return sorted(file for file in path.rglob("*") if file.is_file())


def _attach(attached: dict[str, tuple[str, bytes]], path: Path, name: str = "") -> bool:
    """Attach a file by its own name or another; return False if the name is taken."""
    name = name or path.name
    if name in (*attached, "scene.yaml", "files.txt"):
        return False
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BagError(f"{path} cannot be attached: {error.strerror}") from None
    attached[name] = mimetypes.guess_type(name)[0] or "application/octet-stream", data
    return True


def _files(settings: Any) -> Iterator[Path]:
    if isinstance(settings, dict):
        for value in settings.values():
            yield from _files(value)
    elif isinstance(settings, list | tuple):
        for value in settings:
            yield from _files(value)
    elif dataclasses.is_dataclass(settings):
        rules = rules_of(type(settings))
        for field in dataclasses.fields(settings):
            value = getattr(settings, field.name)
            rule = rules.get(field.name)
            if rule is not None and rule.file and isinstance(value, str):
                yield Path(value)
            else:
                yield from _files(value)


def _placed(document: Any, places: dict[Path, str]) -> Any:
    """Return the document with files named by their places once it is extracted."""
    if isinstance(document, dict):
        return {key: _placed(value, places) for key, value in document.items()}
    if isinstance(document, list):
        return [_placed(value, places) for value in document]
    if isinstance(document, str):
        for path, place in places.items():
            if document.endswith(path.name) and str(path).endswith(document.lstrip("./~")):
                return place
    return document


def file_checksum(path: Path) -> str:
    """Compute the SHA-256 of a file in hexadecimal digits; dashes for what is no file."""
    if not path.is_file():
        return "-" * 64
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise UsSimError(f"{path} cannot be read: {error.strerror}") from None
