"""The history of a case: ``provenance.yaml``, without anything that says whose it is.

A step has a name, the version of us_sim, settings and counts. Of a file that went in it keeps the
kind and checksum, and never its name or path, which carry patients' names.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

import us_sim
from us_sim.errors import CaseError
from us_sim.settings.reading import document_of
from us_sim.settings.setting import Settings, rules_of
from us_sim.settings.spelling import shown
from us_sim.settings.text_files import read_yaml
from us_sim.volume.partial_file import partial_file

PROVENANCE = "provenance.yaml"

_WORDS = re.compile(r"[\w .,:;()\[\]%+*=°µ'|-]{0,120}")
_FILE_NAME = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,5}$")


@dataclass(frozen=True)
class Source:
    """A file that went in: its kind and its checksum.

    Raises:
        CaseError: the kind reads like a name or a path, or the checksum is none.
    """

    kind: str  # such as "tracked sequence"
    sha256: str  # of its bytes, hexadecimal

    def __post_init__(self) -> None:
        _check_text("sources.kind", self.kind)
        if not re.fullmatch(r"[0-9a-f]{64}", self.sha256):
            raise CaseError(f"provenance: sources.sha256: {shown(self.sha256)} is no SHA-256")

    @classmethod
    def of(cls, path: Path, kind: str) -> Source:
        """The source that a file is.

        Raises:
            CaseError: it cannot be read.
        """
        try:
            with path.open("rb") as file:
                return cls(kind, hashlib.file_digest(file, "sha256").hexdigest())
        except OSError as error:
            raise CaseError(f"{path}: cannot be read: {error.strerror}") from error


@dataclass(frozen=True)
class Step:
    """One thing that was done.

    Args:
        what: in a word or a few, in the past: ``reconstructed``.
        settings: numbers, truths, names, and lists and mappings of them; see `settings_said`.
        counts: what there was to count: ``{"frames": 140, "frames left out": 3}``.
        sources: the files that went in.
        version: of us_sim.

    Raises:
        CaseError: a value is of another kind, not finite, or reads like a name or a path.
    """

    what: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    counts: Mapping[str, int | float] = field(default_factory=dict)
    sources: tuple[Source, ...] = ()
    version: str = us_sim.__version__

    def __post_init__(self) -> None:
        _check_text("what", self.what)
        _check_text("version", self.version)
        for name in ("settings", "counts"):
            if not isinstance(getattr(self, name), Mapping):
                raise CaseError(f"provenance: {name}: must be keys with values")
            object.__setattr__(self, name, _checked(name, getattr(self, name)))
        for key, value in self.counts.items():
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise CaseError(f"provenance: counts.{key}: {shown(value)} is no number")
        object.__setattr__(self, "sources", tuple(self.sources))


def settings_said(settings: Settings) -> dict[str, Any]:
    """The settings that a step keeps: those not by default, without those that name files."""
    files = {name for name, rule in rules_of(type(settings)).items() if rule.file}
    said = {key: value for key, value in document_of(settings).items() if key not in files}
    return {key: value for key, value in said.items() if not isinstance(value, Path)}


def read_steps(folder: Path) -> tuple[Step, ...]:
    """The steps in order; none where there is no ``provenance.yaml``.

    Raises:
        CaseError: it cannot be read, or says something else.
    """
    path = folder / PROVENANCE
    if not path.exists():
        return ()
    document = read_yaml(path, CaseError)
    steps = document.get("steps") if isinstance(document, dict) else None
    if not isinstance(steps, list) or len(steps) > 1000 or set(document) != {"steps"}:
        raise CaseError(f"{path}: must have one key, `steps`, with a list of what was done")
    try:
        return tuple(_step(step) for step in steps)
    except (CaseError, TypeError, KeyError) as error:
        raise CaseError(f"{path}: is no provenance that us_sim wrote: {error}") from error


def add_step(folder: Path, step: Step) -> None:
    """Add a step to ``provenance.yaml``.

    Raises:
        CaseError: what is there cannot be read, or it cannot be written.
    """
    steps = [_document(one) for one in (*read_steps(folder), step)]
    text = yaml.safe_dump({"steps": steps}, sort_keys=False, allow_unicode=True, width=100)
    path = folder / PROVENANCE
    with partial_file(path, error_type=CaseError) as partial:
        partial.write_text(text, encoding="utf-8")


def _document(step: Step) -> dict[str, Any]:
    document: dict[str, Any] = {"what": step.what, "us_sim": step.version}
    if step.settings:
        document["settings"] = dict(step.settings)
    if step.counts:
        document["counts"] = dict(step.counts)
    if step.sources:
        document["sources"] = [{"kind": s.kind, "sha256": s.sha256} for s in step.sources]
    return document


def _step(document: Mapping[str, Any]) -> Step:
    if not isinstance(document, Mapping):
        raise CaseError("a step must be keys with values")
    sources = tuple(Source(s["kind"], s["sha256"]) for s in document.get("sources", ()))
    settings, counts = document.get("settings", {}), document.get("counts", {})
    return Step(document["what"], settings, counts, sources, document["us_sim"])


def _checked(key: str, value: Any, depth: int = 0) -> Any:
    if isinstance(value, Mapping) and depth < 8:
        for name in value:
            is_key = isinstance(name, str) and re.fullmatch(r"[A-Za-z_][\w .-]{0,60}", name)
            if not is_key or _FILE_NAME.search(name):
                raise CaseError(f"provenance: {key}: {shown(name)} is no key")
        return {name: _checked(f"{key}.{name}", item, depth + 1) for name, item in value.items()}
    if isinstance(value, bool | None):
        return value
    if hasattr(value, "tolist"):  # of NumPy
        value = value.tolist()
    if isinstance(value, int | float):
        if not math.isfinite(value):
            raise CaseError(f"provenance: {key}: {value} is not finite")
        return value
    if isinstance(value, str):
        return _check_text(key, value)
    if isinstance(value, Sequence) and depth < 8:
        return [_checked(f"{key}[{i}]", item, depth + 1) for i, item in enumerate(value)]
    raise CaseError(f"provenance: {key}: {shown(value)} is no number, truth, text or list of them")


def _check_text(key: str, text: object) -> str:
    if not isinstance(text, str):
        raise CaseError(f"provenance: {key}: must be a text, not {shown(text)}")
    if not _WORDS.fullmatch(text) or _FILE_NAME.search(text):
        raise CaseError(
            f"provenance: {key}: {shown(text)} may say whose it is: keep no names of files, no "
            f"paths and no long texts"
        )
    return text
