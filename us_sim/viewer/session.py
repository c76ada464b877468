"""The session as pages see it: what runs, what can be loaded and played, and how to ask for it.

>>> from us_sim.viewer.session import SessionBoard
>>> board = SessionBoard()
>>> board.state.is_there, board.ask(record="a.mcap").result()
(False, 'us-sim does not run this simulation, so nothing can be loaded or recorded from here')

Hears what `session_control` says while pages show it, and hands on what they ask for.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import CompressedImage

from us_sim.nodes.guarded_node import GuardedNode, shown
from us_sim.nodes.qos import CATALOGUE, LATCHED, STREAM

NOT_THERE = "us-sim does not run this simulation, so nothing can be loaded or recorded from here"

Ask = Callable[[Mapping[str, object]], "Future[str]"]
"""Sets parameters of ``session_control`` together; the future holds why not, or nothing."""


@dataclass(frozen=True)
class LoadableScene:
    """A scene or a case."""

    name: str
    origin: str  # what loads it
    kind: str = "scene"  # or case
    description: str = ""
    region: str = ""  # of the body
    structures: tuple[str, ...] = ()
    tracker: str = ""  # where its poses come from, unless the probe is moved by hand
    problem: str = ""  # why it cannot be loaded


@dataclass(frozen=True)
class SessionState:
    """What the simulation does."""

    is_there: bool = False  # whether somebody answers for it
    state: str = ""  # for a person
    scene: str = ""
    origin: str = ""  # what loads it
    loading: str = ""  # the origin of another scene that is being made
    fraction: float = 1.0  # of loading or starting that is done
    problem: str = ""  # why the last thing that was asked for came to nothing
    record: str = ""  # file that is recorded to, with its folder
    record_note: str = ""  # what is to be known of that file
    record_seconds: float = 0.0  # since when
    record_bytes: float = 0.0  # its size so far
    record_room: float = 0.0  # bytes that are left
    replay: str = ""  # bag that is played
    replay_as: str = "path"
    replay_state: str = ""
    position: float = 0.0  # s, in the replay
    duration: float = 0.0  # s
    rate: float = 1.0  # speed factor
    loop: bool = False
    paused: bool = False

    @property
    def is_busy(self) -> bool:
        """Whether a scene is being loaded, or nodes are starting."""
        return self.fraction < 1.0


class SessionBoard:
    """The newest that is known of the session, and who looks at it; for any thread.

    Args:
        on_watch: called when pages begin to look, or no longer do.
        ask: hands on what a page asks for.
        folder: to which pages record; "" is the one that us-sim runs in.
        is_own: whether all pages are this computer's own; others may ask for what is listed, and
            for recordings in that folder, and not for files anywhere.
    """

    def __init__(
        self,
        on_watch: Callable[[], None] = lambda: None,
        ask: Ask | None = None,
        folder: str = "",
        *,
        is_own: bool = True,
    ) -> None:
        self._on_watch, self._ask = on_watch, ask
        self.folder, self._is_own = folder, is_own
        self._lock = threading.Lock()
        self._pages = 0
        self._state = SessionState()
        self._scenes: tuple[LoadableScene, ...] = ()
        self._thumbnails: dict[str, bytes] = {}
        self._bags: dict[str, str] = {}

    @property
    def is_watched(self) -> bool:
        """Whether a page shows it."""
        return self._pages > 0

    def watch(self) -> None:
        """One more page looks."""
        self._count(1)

    def unwatch(self) -> None:
        """One fewer."""
        self._count(-1)

    def _count(self, more: int) -> None:
        with self._lock:
            before = self.is_watched
            self._pages += more
            changed = before != self.is_watched
        if changed:
            self._on_watch()

    @property
    def state(self) -> SessionState:
        """What the simulation does."""
        return self._state

    @property
    def scenes(self) -> tuple[LoadableScene, ...]:
        """What can be loaded; another object whenever that changes."""
        return self._scenes

    @property
    def bags(self) -> Mapping[str, str]:
        """Files that can be played, by name; another object whenever that changes."""
        return self._bags

    def thumbnail(self, origin: str) -> bytes | None:
        """JPEG of what the probe sees in a scene, once there is one."""
        return self._thumbnails.get(origin)

    def tell_state(self, state: SessionState) -> None:
        """The simulation says what it does."""
        self._state = state

    def tell_scenes(self, scenes: tuple[LoadableScene, ...]) -> None:
        """This can be loaded."""
        self._scenes = scenes

    def tell_thumbnail(self, origin: str, jpeg: bytes) -> None:
        """A scene looks like this."""
        self._thumbnails[origin] = jpeg

    def tell_bags(self, bags: Mapping[str, str]) -> None:
        """These can be played."""
        self._bags = dict(bags)

    def ask(self, **values: object) -> Future[str]:
        """Set parameters of ``session_control``; the future holds why not, or nothing."""
        refusal = "" if self._is_own else self._refusal(values)
        if self._ask is not None and self._state.is_there and not refusal:
            file = values.get("record")
            if self.folder and file:
                values["record"] = str(PurePath(self.folder, str(file)))
            return self._ask(values)
        refused: Future[str] = Future()
        refused.set_result(refusal or NOT_THERE)
        return refused

    def _refusal(self, values: Mapping[str, object]) -> str:
        """Why pages of other computers may not ask for this; "" where they may."""
        file = str(values.get("record") or "")
        if PurePath(file).name != file or file.startswith(("~", "..")):
            return f"record: {file}: give a name without a folder"
        listed = {
            "scene": [self._state.origin, *(each.origin for each in self._scenes)],
            "replay": [self._state.replay, *self._bags.values()],
            "volume": [],
        }
        for key, files in listed.items():
            if values.get(key) and values[key] not in files:
                return f"{key}: {values[key]}: is not one of those that are listed"
        return ""


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
