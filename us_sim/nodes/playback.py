"""How far a player is, at which pace, and whether it holds still: as its parameters say."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.parameter import Parameter

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.session_settings import PathPlayerSettings, SessionPlayerSettings
from us_sim.recording.playhead import Playhead


class Playback:
    """Does as the parameters ``rate``, ``loop``, ``paused`` and ``time`` of a player say.

    Args:
        node: that plays; the state is told in its diagnostics.
        settings: gives them as they are now.
        go_to: has the node play on at a time of the recording, ns.
        say: puts into the node's health how far it is.
    """

    def __init__(
        self,
        node: GuardedNode,
        settings: Callable[[], PathPlayerSettings | SessionPlayerSettings],
        go_to: Callable[[int], None],
        say: Callable[[], None],
    ) -> None:
        self._node, self._settings, self._go_to, self._say = node, settings, go_to, say
        self.head = Playhead(settings().rate)
        self.has_begun = False
        node.add_post_set_parameters_callback(self._seek)

    @property
    def now(self) -> int:
        """ns, of the node's clock."""
        return int(self._node.get_clock().now().nanoseconds)

    def begin(self) -> None:
        """Parameters are obeyed from now on, and those that are set already."""
        self.has_begun = True
        self.use()

    def use(self) -> None:
        """Go on at the rate that was set, or hold still; before it began there is nothing to do."""
        if not self.has_begun:
            return
        settings = self._settings()
        self.head.run_at(settings.rate, self.now)
        self.head.hold(settings.paused, self.now)
        if self._node.health.state != "finished" or settings.loop:
            self._node.health.state = "paused" if settings.paused else "playing"
        self._report()

    def _seek(self, parameters: list[Parameter]) -> None:
        """Play on at a time, each time that it is set, also to what it was."""
        times = [round(1e9 * each.value) for each in parameters if each.name == "time"]
        if not self.has_begun or not times:
            return
        self._go_to(times[-1])
        self._node.health.state = "paused" if self._settings().paused else "playing"
        self._report()

    def _report(self) -> None:
        self._say()
        self._node.health.report()
