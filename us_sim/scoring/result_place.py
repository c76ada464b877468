"""The place where results of attempts are written and read: a folder, or an address of fsspec."""

from __future__ import annotations

import contextlib
import json
import re
import tempfile
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from us_sim.errors import ScoreError

KEPT_FOLDER = "us_sim_results"
"""In the working directory, for results that their place does not take."""


class ResultPlace:
    """A folder or address of fsspec that results are written to, and those it has refused."""

    def __init__(self, address: str) -> None:
        self._address = address.rstrip("/")
        self._kept: list[tuple[dict[str, str], list[str]]] = []  # texts by name; files with them

    def try_out(self) -> None:
        """Write an empty file and remove it.

        Raises:
            ScoreError: it cannot be written.
        """
        [file] = _write_files(self._address, {f"us_sim-{uuid.uuid4().hex}": ""})
        with contextlib.suppress(Exception):  # whoever may not remove may still write
            if "://" in file:
                _fsspec().url_to_fs(file)[0].rm(file)
            else:
                Path(file).unlink()

    def write(self, result: Mapping[str, Any], picture: bytes) -> list[str]:
        """Write the page, with a PNG, and the document; return the two files' addresses.

        They are named by student, exercise and begin.

        Raises:
            ScoreError: they cannot be written; it names the file on this machine that keeps them.
        """
        from us_sim.scoring.result import render_page  # it brings scipy, which only this takes

        about = result["about"]
        words = (about.get("student") or "somebody", result["name"], about["begun"])
        name = "-".join(re.sub(r"[^\w.]+", "_", each).strip("_") for each in words)
        page, document = render_page(result, picture), json.dumps(result, indent=2)
        texts = {f"{name}.html": page, f"{name}.json": document}
        try:
            return _write_files(self._address, texts)
        except ScoreError as error:
            kept: list[str] = []
            for root in (Path.cwd(), Path(tempfile.gettempdir())):
                with contextlib.suppress(ScoreError):
                    kept = kept or _write_files(str(root / KEPT_FOLDER), texts)
            self._kept.append((texts, kept))
            raise _refusal(error, kept) from error

    def write_kept(self) -> list[str]:
        """Write the results that are kept, remove them here, and return their new addresses.

        Raises:
            ScoreError: they still cannot be written; it names the first file.
        """
        written: list[str] = []
        while self._kept:
            texts, kept = self._kept[0]
            try:
                written += _write_files(self._address, texts)
            except ScoreError as error:
                raise _refusal(error, kept) from error
            for file in kept:
                Path(file).unlink(missing_ok=True)
            del self._kept[0]
        return written


def _write_files(address: str, texts: Mapping[str, str]) -> list[str]:
    files = [f"{address}/{name}" for name in texts]
    try:
        for file, text in zip(files, texts.values(), strict=True):
            if "://" in file:
                with _fsspec().open(file, "w", encoding="utf-8") as opened:
                    opened.write(text)
            else:
                Path(file).parent.mkdir(parents=True, exist_ok=True)
                Path(file).write_text(text, encoding="utf-8")
    except Exception as error:  # what a file system raises is its own
        raise ScoreError(f"results: {address}: cannot be written: {error}") from error
    return files


def _refusal(error: ScoreError, kept: Sequence[str]) -> ScoreError:
    return ScoreError(f"{error}; {f'it is kept in {kept[0]}' if kept else 'nor on this machine'}")


def read_results(address: str) -> list[dict[str, Any]]:
    """Return the documents of a folder, or an address of fsspec, by the time of their begin.

    Raises:
        ScoreError: it cannot be read, or holds none.
    """
    try:
        if "://" in address:
            files, folder = _fsspec().url_to_fs(address.rstrip("/"))
            texts = {file: files.cat_file(file) for file in files.glob(f"{folder}/*.json")}
        else:
            texts = {str(file): file.read_bytes() for file in Path(address).glob("*.json")}
    except Exception as error:
        raise ScoreError(f"--class {address}: cannot be read: {error}") from error
    results = [_read(name, text) for name, text in sorted(texts.items())]
    if not results:
        raise ScoreError(f"--class {address}: holds no result of `us-sim view --results`")
    return sorted(results, key=lambda each: str(each["about"]["begun"]))


def _read(name: str, text: bytes) -> dict[str, Any]:
    try:
        result = json.loads(text)
        missing = {"name", "state", "about", "plain", "steps", "faults"} - set(result)
        if missing:
            raise ValueError(f"it has no {', '.join(sorted(missing))}")
        result["about"]["begun"]
    except (ValueError, TypeError, KeyError) as error:
        raise ScoreError(f"{name}: is no result of `us-sim view --results`: {error}") from error
    return dict(result)


def _fsspec() -> Any:
    try:
        import fsspec
    except ImportError as error:
        raise ScoreError("an address needs fsspec: pip install fsspec") from error
    return fsspec
