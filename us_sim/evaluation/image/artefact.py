"""What each artefact that is measured says of itself: its numbers, what is asked, its pictures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from us_sim.evaluation.image.points import Point
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.target import Target


class Artefact(ABC):
    """One file each; `us_sim.evaluation.image.measure` has the list of them."""

    name: ClassVar[str]
    """The first column of its rows: a word, or several with underscores."""
    title: ClassVar[str]
    """The heading of its part of the report."""
    simplified: ClassVar[str]
    """What it leaves out or takes as simpler than it is, a sentence or more."""

    @abstractmethod
    def points(self, quick: bool) -> list[Point]:
        """The rows of image.csv."""

    @abstractmethod
    def targets(self, points: Sequence[Point]) -> list[Target]:
        """What is asked, against its own rows."""

    @abstractmethod
    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:
        """The paragraphs of its part of the report, whose pictures it draws into the folder."""
