"""The session as pages see it: the running scene, what can be loaded and played, and requests.

>>> from us_sim.viewer.session import SessionBoard
>>> board = SessionBoard()
>>> board.state.is_there, board.ask_control(record="a.mcap").result()
(False, 'us-sim does not run this simulation, so nothing can be loaded or recorded from here')
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, fields
from pathlib import PurePath
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from us_sim.nodes.guarded_node import GuardedNode, Subscriptions, loggable_text
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.scene.listing import ListedScene
from us_sim.viewer.remote_parameters import make_answer, set_atomically
from us_sim.viewer.status import PageCounter

NOT_THERE = "us-sim does not run this simulation, so nothing can be loaded or recorded from here"


@dataclass(frozen=True)
class SessionState:
    """State of the simulation: its scene, recording and replay, named as in its report."""

    is_there: bool = False  # whether somebody answers for it
    state: str = ""  # for a person
    scene: str = ""
    origin: str = ""  # what loads it
    fraction: float = 1.0  # of loading or starting that is done
    problem: str = ""  # why the last thing that was asked for came to nothing
    record: str = ""  # file that is recorded to, with its folder
    record_state: str = ""  # of its recorder: starting, recording, paused
    record_note: str = ""  # what is to be known of that file
    record_seconds: float = 0.0  # since when
    record_bytes: float = 0.0  # its size so far
    record_room_bytes: float = 0.0  # what is left
    replay: str = ""  # bag that is played
    replay_as: str = "path"
    replay_state: str = ""
    replay_rate: float = 1.0  # speed factor
    replay_loop: bool = False
    replay_paused: bool = False  # as it was asked for, also before it begins
    position: float = 0.0  # s, in the replay
    duration: float = 0.0  # s

    @property
    def is_busy(self) -> bool:
        """Whether a scene is being loaded, or nodes are starting."""
        return self.fraction < 1.0

    @property
    def is_recording(self) -> bool:
        """Whether the recorder says that it writes."""
        return bool(self.record) and self.record_state == "recording"

    @property
    def is_starting(self) -> bool:
        """Whether a replay does not play yet."""
        return bool(self.replay) and self.replay_state in ("starting", "waiting")

    @property
    def is_playing(self) -> bool:
        """Whether the replay goes on, or will as soon as it is ready."""
        is_awaited = self.is_starting and not self.replay_paused
        return is_awaited or self.replay_state == "playing"

    @classmethod
    def from_status(cls, status: DiagnosticStatus) -> SessionState:
        """Read the report of `session_control`."""
        said = {each.key: each.value for each in status.values}
        values: dict[str, Any] = {"is_there": True, "state": said.get("state", status.message)}
        values["problem"] = status.message if status.level != DiagnosticStatus.OK else ""
        for each in fields(cls):
            text = said.get(each.name)
            if text is None or each.name in values:
                continue
            if isinstance(each.default, bool):
                values[each.name] = text == "true"
            elif isinstance(each.default, str):
                values[each.name] = text
            else:
                with contextlib.suppress(ValueError):
                    values[each.name] = float(text)
        return cls(**values)


class SessionBoard(PageCounter):
    """The newest that is known of the session, and who shows it; for any thread.

    Args:
        on_watch: called when pages begin to show it, or no longer do.
        send: sets parameters of ``session_control`` together; the future holds why not, or nothing.
        folder: to which pages record; "" is the one that us-sim runs in.
        is_own: whether all pages are this computer's own; others may ask for what is listed, and
            for recordings in that folder, and not for files anywhere.
    """

    def __init__(
        self,
        on_watch: Callable[[], None] = lambda: None,
        send: Callable[[Mapping[str, object]], Future[str]] | None = None,
        folder: str = "",
        *,
        is_own: bool = True,
    ) -> None:
        super().__init__(on_watch)
        self._send_to_control = send
        self.folder, self._is_own = folder, is_own
        self.state = SessionState()
        self.scenes: tuple[ListedScene, ...] = ()  # another object whenever it changes
        self.bags: Mapping[str, str] = {}  # files that can be played, by name

    def ask_control(self, **values: object) -> Future[str]:
        """Set parameters of ``session_control``; the future holds why not, or nothing."""
        refusal = "" if self._is_own else self._refusal(values)
        if self._send_to_control is not None and self.state.is_there and not refusal:
            file = values.get("record")
            if self.folder and file:
                values["record"] = str(PurePath(self.folder, str(file)))
            return self._send_to_control(values)
        return make_answer(refusal or NOT_THERE)

    def _refusal(self, values: Mapping[str, object]) -> str:
        """Why pages of other computers may not ask for this; "" where they may."""
        file = str(values.get("record") or "")
        if PurePath(file).name != file or file.startswith(("~", "..")):
            return f"record: {file}: give a name without a folder"
        listed = {
            "scene": [self.state.origin, *(each.origin for each in self.scenes)],
            "replay": [self.state.replay, *self.bags.values()],
            "volume": [],
        }
        for key, files in listed.items():
            if values.get(key) and values[key] not in files:
                return f"{key}: {values[key]}: is not one of those that are listed"
        return ""


CONTROL = "session_control"
_EVERY_S = 0.5
SILENT_S = 3.0
"""Without a word, after which nobody answers for the simulation: it says something every second."""


class ViewerSession(SessionBoard):
    """A board that follows the session's topics while a page shows it, and asks `session_control`.

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
        super().__init__(lambda: post(self._listen), self._send, folder, is_own=is_own)
        self._node = node
        self._name = f"{node.get_namespace().rstrip('/')}/{CONTROL}"
        self._subscriptions = Subscriptions(
            node,
            (DiagnosticArray, "diagnostics", self._hear, STREAM, False),
            (DiagnosticArray, "session/scenes", self._take_scenes, LATCHED, False),
            (DiagnosticArray, "session/bags", self._take_bags, LATCHED, False),
        )
        self._timer = node.create_timer(_EVERY_S, self._check)
        self._timer.cancel()
        self._client: AsyncParameterClient | None = None
        self._heard = 0.0
        self.on_other_scene: Callable[[], None] = lambda: None
        """Called in the node's thread when another scene takes the place of one."""

    def _listen(self) -> None:
        if self.is_watched and self._client is None:
            self._client = AsyncParameterClient(self._node, CONTROL)
        if self._subscriptions.set_active(self.is_watched):
            (self._timer.reset if self.is_watched else self._timer.cancel)()

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._name:
                self._heard = time.monotonic()
                before, self.state = self.state, SessionState.from_status(status)
                if before.is_there and before.origin != self.state.origin:
                    self.on_other_scene()

    def _take_scenes(self, message: DiagnosticArray) -> None:
        self.scenes = tuple(map(_scene_of, message.status))

    def _take_bags(self, message: DiagnosticArray) -> None:
        self.bags = {loggable_text(status.name): status.hardware_id for status in message.status}

    def _check(self) -> None:
        """Notice when nobody answers for the simulation any more."""
        if self.state.is_there and time.monotonic() - self._heard > SILENT_S:
            self.state = SessionState()

    def _send(self, values: Mapping[str, object]) -> Future[str]:
        if self._client is None:
            return make_answer(NOT_THERE)
        return set_atomically(self._client, [Parameter(n, value=v) for n, v in values.items()])


def _scene_of(status: DiagnosticStatus) -> ListedScene:
    about = {each.key: loggable_text(each.value) for each in status.values}
    is_wrong = status.level != DiagnosticStatus.OK
    said = loggable_text(status.message)
    return ListedScene(
        loggable_text(status.name),
        status.hardware_id,
        about.get("kind", "scene"),
        "" if is_wrong else said,
        about.get("region", ""),
        _names(about.get("structures", "")),
        about.get("probe", ""),
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
