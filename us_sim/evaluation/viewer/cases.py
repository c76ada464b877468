"""The ways to look at the arm that are measured.

>>> from us_sim.evaluation.viewer.cases import cases
>>> [str(case) for case in cases(quick=True)][:2]
['no viewer, path', 'viewer without a page, path']
"""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Case:
    """One way to run the scene ``upper_arm`` with `us-sim`."""

    viewer: bool = True  # the node runs
    takers: int = 0  # pages that take everything that streams, and do not draw it
    browsers: int = 0  # pages in a Chromium without a window, which draws with the processor
    by_hand: bool = False  # a page moves the probe; else a path is played at 60 Hz
    seconds: float = 20.0

    def __str__(self) -> str:
        takers = "page that takes" if self.takers == 1 else "pages that take"
        browsers = "browser" if self.browsers == 1 else "browsers"
        counted = [(self.takers, takers), (self.browsers, browsers)]
        pages = [f"{count} {name}" for count, name in counted if count]
        pages = pages or ["viewer without a page" if self.viewer else "no viewer"]
        return ", ".join([*pages, "hand" if self.by_hand else "path"])


def cases(quick: bool) -> list[Case]:
    """Those of a run; of a quick one for some seconds each."""
    chosen = [
        Case(viewer=False),
        Case(),
        Case(takers=1),
        Case(takers=2),
        Case(takers=1, by_hand=True),
        Case(browsers=1),
        Case(browsers=1, by_hand=True),
        Case(browsers=2),
    ]
    if quick:
        return [replace(case, seconds=8.0) for case in chosen]
    return [*chosen, Case(browsers=1, seconds=600.0)]
