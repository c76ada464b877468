"""The services by which rosbag2's player is controlled: they set the player's own parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from us_sim.nodes.rosbag2_service import offer_service
from us_sim.nodes.session_settings import PathPlayerSettings, SessionPlayerSettings


def offer_player_services(
    node: Node,
    settings: Callable[[], PathPlayerSettings | SessionPlayerSettings],
    first: int,
    length: int,
) -> None:
    """Offer them where ``rosbag2_interfaces`` is installed.

    Args:
        node: that plays, with the parameters ``rate``, ``paused`` and ``time``.
        settings: gives them as they are now.
        first: ns since 1970, when what is played was recorded: `seek` counts as its stamps do.
        length: ns.
    """

    def set_to(name: str, value: object) -> bool:
        result = node.set_parameters_atomically([Parameter(name, value=value)])
        return bool(result.successful)

    def seek(request: Any, response: Any) -> None:
        position = 1_000_000_000 * request.time.sec + request.time.nanosec - first
        inside = 0 <= position <= length
        response.success = inside and set_to("time", 1e-9 * position)

    def set_rate(request: Any, response: Any) -> None:
        response.success = set_to("rate", request.rate)

    def offer(service: str, name: str, act: Callable[[Any, Any], Any]) -> None:
        offer_service(node, service, name, act)

    offer("Pause", "pause", lambda *_: set_to("paused", True))
    offer("Resume", "resume", lambda *_: set_to("paused", False))
    offer("TogglePaused", "toggle_paused", lambda *_: set_to("paused", not settings().paused))
    offer("IsPaused", "is_paused", lambda _, answer: setattr(answer, "paused", settings().paused))
    offer("GetRate", "get_rate", lambda _, answer: setattr(answer, "rate", settings().rate))
    offer("SetRate", "set_rate", set_rate)
    offer("Seek", "seek", seek)
