"""Services and events of rosbag2's recorder and player, where its interfaces are installed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.sessions.playback import Playback
from us_sim.nodes.settings import LOST, PlayerSettings
from us_sim.recording.write_behind import Loss

if TYPE_CHECKING:
    from us_sim.nodes.session_recorder import SessionRecorder


def offer_service(node: Node, service: str, name: str, act: Callable[[Any, Any], Any]) -> bool:
    """Offer a service as a node of rosbag2 does; False where its type is not known here.

    Args:
        node: that offers it.
        service: its type in ``rosbag2_interfaces``, without the package.
        name: below the node's own.
        act: does what the request asks for, and fills the response.
    """
    try:
        from rosbag2_interfaces import srv
    except ImportError:
        return False

    def answer(request: Any, response: Any) -> Any:
        act(request, response)
        return response

    if not hasattr(srv, service):
        return False
    node.create_service(getattr(srv, service), f"~/{name}", answer)
    return True


def offer_player_services(
    node: Node, playback: Playback, settings: Callable[[], PlayerSettings], stop: Callable[[], None]
) -> None:
    """Offer them where ``rosbag2_interfaces`` is installed.

    Args:
        node: that plays, with the parameters ``rate``, ``paused`` and ``time``.
        playback: what it plays.
        settings: gives its parameters as they are now.
        stop: ends playing.
    """

    def set_to(name: str, value: object) -> bool:
        result = node.set_parameters_atomically([Parameter(name, value=value)])
        return bool(result.successful)

    def seek(request: Any, response: Any) -> None:
        position = _nanoseconds(request.time) - playback.first
        inside = 0 <= position <= playback.length
        response.success = inside and set_to("time", 1e-9 * position)

    def set_rate(request: Any, response: Any) -> None:
        response.success = set_to("rate", request.rate)

    def play(request: Any, response: Any) -> None:
        response.success = playback.play(
            _nanoseconds(request.start_offset),
            _nanoseconds(request.playback_duration),
            _nanoseconds(request.playback_until_timestamp),
        )

    def play_next(_: Any, response: Any) -> None:
        response.success = playback.may_step() and playback.step()

    def burst(request: Any, response: Any) -> None:
        most = request.num_messages or sys.maxsize  # 0 is all
        while response.actually_burst < most and playback.may_step() and playback.step():
            response.actually_burst += 1

    offer = partial(offer_service, node)
    offer("Pause", "pause", lambda *_: set_to("paused", True))
    offer("Resume", "resume", lambda *_: set_to("paused", False))
    offer("TogglePaused", "toggle_paused", lambda *_: set_to("paused", not settings().paused))
    offer("IsPaused", "is_paused", lambda _, answer: setattr(answer, "paused", settings().paused))
    offer("GetRate", "get_rate", lambda _, answer: setattr(answer, "rate", settings().rate))
    offer("SetRate", "set_rate", set_rate)
    offer("Seek", "seek", seek)
    offer("Play", "play", play)
    offer("PlayNext", "play_next", play_next)
    offer("Burst", "burst", burst)
    offer("Stop", "stop", lambda *_: stop())


def _nanoseconds(time: Any) -> int:
    return int(1_000_000_000 * time.sec + time.nanosec)


def offer_services(recorder: SessionRecorder) -> bool:
    """Offer rosbag2's services; False where ``rosbag2_interfaces`` is not installed."""
    offer = partial(offer_service, recorder)

    def toggle(_: Any, __: Any) -> None:
        (recorder.resume if recorder.paused else recorder.pause)()

    def told(response: Any, problem: str) -> None:
        if hasattr(response, "return_code"):  # newer than Jazzy
            response.return_code, response.error_string = int(bool(problem)), problem

    def stop(_: Any, response: Any) -> None:
        told(response, "" if recorder.file else "nothing is recorded")
        recorder.stop()

    def discover(wanted: bool, _: Any, response: Any) -> None:
        is_change, recorder.discovers = recorder.discovers != wanted, wanted
        told(response, "" if is_change else "that is so already")

    if not offer("Pause", "pause", lambda *_: recorder.pause()):
        return False
    offer("Resume", "resume", lambda *_: recorder.resume())
    offer("TogglePaused", "toggle_paused", toggle)
    offer("IsPaused", "is_paused", lambda _, answer: setattr(answer, "paused", recorder.paused))
    offer("SplitBagfile", "split_bagfile", lambda *_: recorder.split())
    offer("Stop", "stop", stop)
    offer(
        "Snapshot",
        "snapshot",
        lambda _, answer: setattr(answer, "success", recorder.snapshot()),
    )
    # Newer than Jazzy:
    offer("Record", "record", lambda request, answer: told(answer, recorder.record(request.uri)))
    offer("StartDiscovery", "start_discovery", partial(discover, True))
    offer("StopDiscovery", "stop_discovery", partial(discover, False))
    offer(
        "IsDiscoveryRunning",
        "is_discovery_running",
        lambda _, answer: setattr(answer, "running", recorder.discovers),
    )
    offer(
        "GetSubscribedTopics",
        "get_subscribed_topics",
        lambda _, answer: setattr(answer, "topics", recorder.topics),
    )
    offer(
        "IsRecording",
        "is_recording",
        lambda _, answer: setattr(answer, "recording", bool(recorder.file)),
    )
    offer("GetUri", "get_uri", lambda _, answer: setattr(answer, "uri", recorder.file))
    return True


class RecorderEvents:
    """Publishes rosbag2's events, as far as ``rosbag2_interfaces`` has their types."""

    SPLIT = "events/write_split"

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._msg: Any = None
        self._split: Any = None
        self._lost: Any = None
        try:
            from rosbag2_interfaces import msg
        except ImportError:
            return
        self._msg = msg
        self._split = node.stream(msg.WriteSplitEvent, self.SPLIT, QoSProfile(depth=1))
        if hasattr(msg, "MessagesLostEvent"):  # newer than Jazzy
            self._lost = node.stream(msg.MessagesLostEvent, LOST)

    def split(self, closed: str, opened: str) -> None:
        """A file was closed, and another one begun; none when the recording ended."""
        if self._split is not None:
            name = self._node.get_fully_qualified_name()
            event = self._msg.WriteSplitEvent(
                closed_file=closed, opened_file=opened, node_name=name
            )
            self._split.publish(event)

    def lost(self, losses: Mapping[str, Loss]) -> None:
        """Messages were lost since this was said last.

        Events that were lost themselves make no further event: it may be lost, too.
        """
        own = self._node.resolve_topic_name(LOST)
        losses = {topic: loss for topic, loss in losses.items() if topic != own}
        if self._lost is None or not losses:
            return
        event = self._msg.MessagesLostEvent(node_name=self._node.get_fully_qualified_name())
        event.messages_lost_statistics = [
            self._msg.MessagesLostEventTopicStat(
                topic_name=topic,
                messages_lost_in_transport=loss.in_transport,
                messages_lost_in_recorder=loss.in_recorder,
            )
            for topic, loss in losses.items()
        ]
        self._lost.publish(event)
