"""The history of a case: ``provenance.yaml``, without anything that says whose it is.

A step has a name, the version of us_sim, settings and counts. Of a file that went in it keeps the
kind and checksum, and never its name or path, which carry patients' names.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

import us_sim
from us_sim.errors import CaseError
from us_sim.settings.text_files import read_yaml
from us_sim.volume.partial_file import partial_file

PROVENANCE = "provenance.yaml"


@dataclass(frozen=True)
class Source:
    """A file that went in: its kind and its checksum."""

    kind: str  # such as "tracked sequence"
    sha256: str  # of its bytes, hexadecimal

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
    """One thing that was done; nothing in it is free text, a file's name or a path.

    Args:
        what: in a word or a few, in the past: ``reconstructed``.
        settings: numbers, truths, words, and lists and mappings of them.
        counts: what there was to count: ``{"frames": 140, "frames left out": 3}``.
        sources: the files that went in.
        version: of us_sim.
    """

    what: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    counts: Mapping[str, int | float] = field(default_factory=dict)
    sources: tuple[Source, ...] = ()
    version: str = us_sim.__version__


def read_steps(folder: Path) -> tuple[Step, ...]:
    """The steps in order; none where there is no ``provenance.yaml``.

    Raises:
        CaseError: it cannot be read, or says something else.
    """
    path = folder / PROVENANCE
    if not path.exists():
        return ()
    document = read_yaml(path, CaseError)
    try:
        return tuple(
            Step(
                step["what"],
                step.get("settings", {}),
                step.get("counts", {}),
                tuple(Source(**source) for source in step.get("sources", ())),
                step["us_sim"],
            )
            for step in document["steps"]
        )
    except (AttributeError, KeyError, TypeError) as error:
        raise CaseError(f"{path}: is no provenance that us_sim wrote; remove it") from error


def add_step(folder: Path, step: Step) -> None:
    """Add a step to ``provenance.yaml``.

    Raises:
        CaseError: what is there cannot be read, or it cannot be written.
    """
    steps = [
        {
            "what": one.what,
            "us_sim": one.version,
            "settings": one.settings,
            "counts": one.counts,
            "sources": [vars(source) for source in one.sources],
        }
        for one in (*read_steps(folder), step)
    ]
    kept = [{key: value for key, value in one.items() if value} for one in steps]
    plain = json.loads(json.dumps(kept, default=lambda of_numpy: of_numpy.tolist()))
    text = yaml.safe_dump({"steps": plain}, sort_keys=False, allow_unicode=True, width=100)
    with partial_file(folder / PROVENANCE, error_type=CaseError) as partial:
        partial.write_text(text, encoding="utf-8")
