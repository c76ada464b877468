"""Studies that hold the simulator against what others measured, and their findings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path

from us_sim.evaluation.report import ReportFolder, Row, not_a_column


@dataclass(frozen=True)
class Finding(Row):
    """A measured quantity beside its prediction; a row of measured.csv.

    Numbers that are not known are NaN.
    """

    study: str
    case: str
    quantity: str
    unit: str
    measured: float = nan
    predicted: float = nan
    error: float = nan  # of the prediction, in the quantity's unit
    floor: float = nan  # error that the measurement itself has, in the same unit
    fitted_on: str = ""  # data that parameters were fitted on; empty where none were
    ms: float = nan  # of an interactive frame of the same model
    headline: bool = not_a_column(True)  # whether the report's first table has it


@dataclass(frozen=True)
class Section:
    """A study's part of the report."""

    heading: str
    text: str  # Markdown, which names pictures that were drawn beside the report
    findings: Sequence[Finding]


@dataclass(frozen=True)
class Study:
    """Where a study's data come from, and the function that measures.

    The function takes the folder with the data, and the report whose pictures it draws.
    """

    name: str
    folder: str  # below the folder of all data; empty where the study needs none
    address: str  # public, with the revision, from which a user fetches the data
    licence: str
    citation: str
    measure: Callable[[Path, ReportFolder], Section]
