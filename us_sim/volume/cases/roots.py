"""Where cases are kept, and which there are.

Folders of cases are those in the environment variable US_SIM_CASES, or the folder ``cases`` in the
user's data folder. A case is named by its folder in one of them, or by its path.

>>> import os, tempfile
>>> from us_sim.volume.cases.roots import case_roots, find_case
>>> with tempfile.TemporaryDirectory() as os.environ["US_SIM_CASES"]:
...     find_case("livr")
Traceback (most recent call last):
...
us_sim.errors.CaseError: there is no case livr; there is none in ...
>>> del os.environ["US_SIM_CASES"]
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import platformdirs

from us_sim.errors import CaseError
from us_sim.settings.spelling import nearest
from us_sim.volume.cases.case import CASE, is_case


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
    for folder in (*folders, Path.cwd()):
        if str(name) and is_case(folder / path):
            return (folder / path).resolve()
    roots = case_roots()
    known: dict[str, Path] = {}
    for root in roots:
        if root.is_dir():
            for case in cases_in(root):
                known.setdefault(case.name, case)
    if str(name) in known:
        return known[str(name)].resolve()
    for folder in (*folders, Path.cwd()):
        if str(name) and (folder / path).exists():
            kind = f"folder without a {CASE}" if (folder / path).is_dir() else "file"
            raise CaseError(f"{name}: is a {kind}, and there is no case of that name")
    like = nearest(name, known)
    there = f"cases are {', '.join(known)}" if known else "there is none"
    raise CaseError(
        f"there is no case {name}; {there} in {', '.join(map(str, roots))}"
        + (f"; did you mean {like}?" if like else "")
    )
