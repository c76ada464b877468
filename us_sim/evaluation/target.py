"""What is asked of a measure, against what was seen in one run.

>>> from us_sim.evaluation.target import Target
>>> Target("an image", "at most 2 ms", "1.5 ms", True).cells
('an image', 'at most 2 ms', '1.5 ms', 'yes')
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Target"]


@dataclass(frozen=True)
class Target:
    """One line of a report's table of targets."""

    what: str
    asked: str
    seen: str
    met: bool | None  # None where it was not measured

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Of the table."""
        return self.what, self.asked, self.seen, {True: "yes", False: "no", None: ""}[self.met]
