"""The score as pages see it: an exercise's steps and the metrics, as `scorer` says them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_msgs.msg import String
from std_srvs.srv import Trigger

from us_sim.nodes.guarded_node import GuardedNode, Subscriptions, shown
from us_sim.nodes.qos import LATCHED, STREAM, overridable
from us_sim.nodes.topics import FROZEN, MARKERS

if TYPE_CHECKING:
    from us_sim.viewer.stream import Simulator


class ToldStep(NamedTuple):
    """A step of an exercise."""

    what: str
    is_done: bool
    seen: str


@dataclass(frozen=True)
class ToldScore:
    """The last message of `scorer`."""

    name: str = ""  # of the exercise, or of the scene; empty before anything was said
    description: str = ""
    metrics: Mapping[str, str] = field(default_factory=dict)
    steps: tuple[ToldStep, ...] = ()


class ScoreBoard:
    """The newest score, and how many pages show it; for any thread.

    Args:
        on_watch: called when pages begin to show it, or no longer do.
        clear: has the score begin anew.
    """

    def __init__(
        self, on_watch: Callable[[], None] = lambda: None, clear: Callable[[], None] = lambda: None
    ) -> None:
        self._on_watch, self.clear = on_watch, clear
        self._lock = threading.Lock()
        self._pages = 0
        self.score = ToldScore()

    @property
    def is_watched(self) -> bool:
        """Whether a page shows it."""
        return self._pages > 0

    def watch(self, pages: int = 1) -> None:
        """Count so many pages more that show it; fewer where negative."""
        with self._lock:
            before = self.is_watched
            self._pages += pages
        if before != self.is_watched:
            self._on_watch()


class ScoreListener(ScoreBoard):
    """A board that hears ``score`` while a page shows it, and marks when an image is frozen.

    Args:
        node: that listens.
        post: has work done in the thread that spins ``node``.
    """

    def __init__(self, node: GuardedNode, post: Callable[[Callable[[], Any]], Any]) -> None:
        super().__init__(lambda: post(self._listen), lambda: post(self._begin_anew))
        self._post = post
        self._heard = Subscriptions(node, (DiagnosticArray, "score", self._hear, LATCHED, False))
        self._scorer = node.create_client(Trigger, "scorer/clear")
        self._marks = node.create_publisher(
            String, MARKERS, STREAM, qos_overriding_options=overridable()
        )

    def take_commands(self, simulator: Simulator) -> None:
        """Obey pages that say that they have frozen the image."""
        simulator.commands["frozen"] = self._mark

    def _mark(self, is_frozen: Any, _: int) -> str | None:
        if is_frozen is True:
            self._post(lambda: self._marks.publish(String(data=FROZEN)))
        return None

    def _listen(self) -> None:
        self._heard.keep(self.is_watched)
        if not self.is_watched:
            self.score = ToldScore()

    def _begin_anew(self) -> None:
        if self._scorer.service_is_ready():
            self._scorer.call_async(Trigger.Request())

    def _hear(self, message: DiagnosticArray) -> None:
        first, *steps = message.status or [DiagnosticStatus()]
        self.score = ToldScore(
            shown(first.name),
            shown(first.message),
            {shown(each.key): shown(each.value) for each in first.values},
            tuple(
                ToldStep(shown(s.name), s.level == DiagnosticStatus.OK, shown(s.message))
                for s in steps
            ),
        )
