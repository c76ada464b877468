"""Making case folders and changing their settings.

A new case is written into a folder beside its place, checked, and renamed; on any error that folder
is removed. Of a case that is there each file is replaced whole.
"""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import yaml

from us_sim.errors import CaseError, VolumeError
from us_sim.settings.reading import dump_settings
from us_sim.volume.cases.case import CASE, read_case
from us_sim.volume.cases.proposal import complete_settings
from us_sim.volume.cases.settings import CaseSettings, check_name
from us_sim.volume.partial_file import partial_file


@contextmanager
def new_case(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Make a folder to fill, which becomes the new case at the end, when it is one.

    Parents of the new case's folder are made.

    Raises:
        CaseError: there is something at that place already, it cannot be made, or what was written
            is no case.
    """
    place = Path(os.path.abspath(os.path.expanduser(folder)))
    if problem := check_name(place.name):
        raise CaseError(f"{folder}: {problem}")
    if os.path.lexists(place):
        raise CaseError(f"{place}: exists already; choose another name, or remove it")
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        partial = place.with_name(f".{place.name}.partial-{uuid.uuid4().hex}")
        partial.mkdir()
    except OSError as error:
        raise CaseError(f"{place}: cannot be made: {error.strerror}") from error
    try:
        yield partial
        _finish(place, partial)
        os.rename(partial, place)
    except OSError as error:
        raise CaseError(f"{place}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_case_settings(folder: Path, settings: CaseSettings) -> None:
    """Write ``case.yaml`` into the folder of a case; one that is there is replaced.

    Raises:
        CaseError: it cannot be written.
    """
    document = dump_settings(settings)
    text = yaml.safe_dump(
        document, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )
    with partial_file(folder / CASE, error_type=CaseError) as partial:
        partial.write_text(text, encoding="utf-8")


def _finish(folder: Path, partial: Path) -> None:
    """Propose a start where none is said; refuse a folder that is no case.

    Errors name the place that it was meant for.
    """
    try:
        case = read_case(partial)
        case.check_grids()
        start = case.settings.start
        if start is None or start.proposed or case.settings.probe is None:
            write_case_settings(partial, complete_settings(case.settings, case.read_volume()))
    except (CaseError, VolumeError) as error:
        raise type(error)(str(error).replace(str(partial), str(folder))) from error
