"""Hears what `session_control` says while pages show it, and hands on what they ask for."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import CompressedImage

from us_sim.nodes.guarded_node import GuardedNode, shown
from us_sim.nodes.qos import CATALOGUE, LATCHED, STREAM
from us_sim.viewer.session import NOT_THERE, LoadableScene, SessionBoard, SessionState

CONTROL = "session_control"
LOOK_S = 0.5
SILENT_S = 3.0
"""Without a word, after which nobody answers for the simulation: it says something every second."""
ANSWER_S = 10.0
"""For it to answer, which it may do late while it reads a scene."""


class ViewerSession:
    """Fills a board from the session's topics, which are subscribed to while a page looks.

    Args:
        node: that listens.
        post: has work done in the thread that spins ``node``.
        folder, is_own: as for `SessionBoard`.
    """

    def __init__(
        self,
        node: GuardedNode,
        post: Callable[[Callable[[], Any]], Any],
        folder: str = "",
        *,
        is_own: bool = True,
    ) -> None:
        self._node, self._post = node, post
        self._name = f"{node.get_namespace().rstrip('/')}/{CONTROL}"
        self._subscriptions: list[Any] = []
        self._timer: Any = None
        self._client: AsyncParameterClient | None = None
        self._heard = 0.0
        self._asked: list[tuple[Future[str], float]] = []  # and when that was
        self.board = SessionBoard(lambda: post(self._look), self._ask, folder, is_own=is_own)

    def close(self) -> None:
        """No answer is waited for any more."""
        for told, _ in self._asked:
            if not told.done():
                told.set_result("the viewer ends")

    def _look(self) -> None:
        """Listen, or not, as pages look now."""
        wanted = self.board.is_watched
        if wanted and not self._subscriptions:
            if self._client is None:
                self._client = AsyncParameterClient(self._node, CONTROL)
            for message_type, topic, callback, qos in (
                (DiagnosticArray, "diagnostics", self._hear, STREAM),
                (DiagnosticArray, "session/scenes", self._list, LATCHED),
                (CompressedImage, "session/thumbnails", self._picture, CATALOGUE),
                (DiagnosticArray, "session/bags", self._offer, LATCHED),
            ):
                self._subscriptions.append(
                    self._node.create_subscription(message_type, topic, callback, qos)
                )
            self._timer = self._node.create_timer(LOOK_S, self._check)
        elif not wanted and self._subscriptions:
            for subscription in self._subscriptions:
                self._node.destroy_subscription(subscription)
            self._subscriptions.clear()
            self._node.destroy_timer(self._timer)
            self._timer = None

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._name:
                self._heard = time.monotonic()
                self.board.tell_state(_state_of(status))

    def _list(self, message: DiagnosticArray) -> None:
        self.board.tell_scenes(tuple(map(_scene_of, message.status)))

    def _picture(self, message: CompressedImage) -> None:
        self.board.tell_thumbnail(message.header.frame_id, bytes(message.data))

    def _offer(self, message: DiagnosticArray) -> None:
        self.board.tell_bags({shown(status.name): status.hardware_id for status in message.status})

    def _check(self) -> None:
        """Notice when nobody answers for the simulation any more."""
        now = time.monotonic()
        if self.board.state.is_there and now - self._heard > SILENT_S:
            self.board.tell_state(SessionState())
        for told, asked in self._asked:
            if not told.done() and now - asked > ANSWER_S:
                told.set_result(f"{CONTROL} has not answered for {ANSWER_S:g} s")
        self._asked = [(told, asked) for told, asked in self._asked if not told.done()]

    def _ask(self, values: Mapping[str, object]) -> Future[str]:
        told: Future[str] = Future()

        def ask() -> None:
            if self._client is None or not self._client.services_are_ready():
                told.set_result(NOT_THERE)
                return
            self._asked.append((told, time.monotonic()))
            parameters = [Parameter(name, value=value) for name, value in values.items()]
            answer = self._client.set_parameters_atomically(parameters)
            answer.add_done_callback(lambda done: _tell(told, done))

        if self._post(ask).cancelled():
            told.set_result("the viewer ends")
        return told


def _tell(told: Future[str], answer: Any) -> None:
    if told.done():
        return
    try:
        told.set_result(answer.result().result.reason)
    except Exception as error:  # whatever the middleware raises
        told.set_result(f"{CONTROL} cannot be asked: {error}")


def _scene_of(status: DiagnosticStatus) -> LoadableScene:
    about = {each.key: shown(each.value) for each in status.values}
    is_wrong = status.level != DiagnosticStatus.OK
    said = shown(status.message)
    return LoadableScene(
        shown(status.name),
        status.hardware_id,
        about.get("kind", "scene"),
        "" if is_wrong else said,
        about.get("region", ""),
        _names(about.get("structures", "")),
        about.get("tracker", ""),
        said if is_wrong else "",
    )


def _names(text: str) -> tuple[str, ...]:
    """The texts of a JSON list; none where it is no such list."""
    try:
        listed = json.loads(text)
    except (ValueError, RecursionError):
        return ()
    return tuple(map(str, listed)) if isinstance(listed, list) else ()


def _state_of(status: DiagnosticStatus) -> SessionState:
    said = {each.key: each.value for each in status.values}

    def number(key: str, otherwise: float) -> float:
        try:
            return float(said[key])
        except (KeyError, ValueError):
            return otherwise

    return SessionState(
        is_there=True,
        state=said.get("state", status.message),
        scene=said.get("scene", ""),
        origin=said.get("origin", ""),
        loading=said.get("loading", ""),
        fraction=number("fraction", 1.0),
        problem=status.message if status.level != DiagnosticStatus.OK else "",
        record=said.get("record", ""),
        record_note=said.get("record_note", ""),
        record_seconds=number("record_seconds", 0.0),
        record_bytes=number("record_bytes", 0.0),
        record_room=number("record_room_bytes", 0.0),
        replay=said.get("replay", ""),
        replay_as=said.get("replay_as", "path"),
        replay_state=said.get("replay_state", ""),
        position=number("position", 0.0),
        duration=number("duration", 0.0),
        rate=number("replay_rate", 1.0),
        loop=said.get("replay_loop", "") == "true",
        paused=said.get("replay_paused", "") == "true",
    )
