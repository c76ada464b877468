"""The simulator as the page sees it: what streams, and what can be asked of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from us_sim.slicing.settings import STRIPS
from us_sim.viewer.feed import Feed
from us_sim.viewer.parameter_board import ParameterBoard
from us_sim.viewer.session import SessionBoard
from us_sim.viewer.status import StatusBoard

Command = Callable[[Any, int], str | None]
"""Takes what a page sent, and the page's number; returns what is wrong with it, or None."""


@dataclass
class Simulator:
    """Filled by whoever knows the graph: the node ``viewer``, or a test."""

    feeds: dict[str, Feed] = field(default_factory=dict)  # by kind
    commands: dict[str, Command] = field(default_factory=dict)  # by the key of the page's message
    nodes: ParameterBoard = field(default_factory=ParameterBoard)  # what can be set of them
    status: StatusBoard = field(default_factory=StatusBoard)  # how they are
    session: SessionBoard = field(default_factory=SessionBoard)  # what is loaded and played
    leaving: list[Callable[[int], object]] = field(default_factory=list)
    """Called with a page's number when it has gone."""

    @property
    def is_changing_by_itself(self) -> bool:
        """Whether a page watches what goes on while the probe rests: blood, or a strip of time."""

        def watched(kind: str) -> bool:
            return kind in self.feeds and self.feeds[kind].is_watched

        overlay = self.nodes.of("slice_interpolator").parameters.get("overlay")
        colours = overlay is not None and overlay.raw == "velocity" and watched("annotated")
        return colours or any(map(watched, STRIPS))

    def add(self, *feeds: Feed) -> None:
        """Let pages watch these."""
        self.feeds |= {feed.kind: feed for feed in feeds}
