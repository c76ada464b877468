"""What is asked of a measure, against what was seen in one run.

>>> from us_sim.evaluation.target import Target
>>> Target.at_most("an image", 2.0, 1.5, "ms").cells
('an image', 'at most 2 ms', '1.5 ms', 'yes')
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from us_sim.evaluation.markdown_table import markdown_table


@dataclass(frozen=True)
class Target:
    """One line of a report's table of targets."""

    what: str
    asked: str
    seen: str = "not measured"
    met: bool | None = None  # None where it was not measured

    @classmethod
    def at_most(
        cls, what: str, limit: float, seen: float, unit: str = "", *, form: str = ".3g"
    ) -> Target:
        """A limit from above; ``seen`` is NaN where it was not measured."""
        return cls._limit(what, f"at most {limit:g}", seen, seen <= limit, unit, form)

    @classmethod
    def under(cls, what: str, limit: float, seen: float, unit: str = "") -> Target:
        """A limit from above that is itself too much."""
        return cls._limit(what, f"under {limit:g}", seen, seen < limit, unit, ".3g")

    @classmethod
    def at_least(cls, what: str, limit: float, seen: float, *, form: str = ".3g") -> Target:
        """A limit from below."""
        return cls._limit(what, f"at least {limit:g}", seen, seen >= limit, "", form)

    @classmethod
    def _limit(cls, what: str, asked: str, seen: float, met: bool, unit: str, form: str) -> Target:
        unit = unit and f" {unit}"
        if not np.isfinite(seen):
            return cls(what, asked + unit)
        return cls(what, asked + unit, f"{seen:{form}}{unit}", bool(met))

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Its cells in the table."""
        return self.what, self.asked, self.seen, {True: "yes", False: "no", None: ""}[self.met]


def target_table(targets: Sequence[Target]) -> str:
    """All of them in Markdown."""
    return markdown_table(("", "asked", "seen", "met"), [target.cells for target in targets])
