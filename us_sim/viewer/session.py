"""The session for pages: the running scene, scenes to load, recordings to play, and requests.

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

    is_there: bool = False  # us-sim runs the simulation and reports
    state: str = ""  # for a person
    scene: str = ""
    origin: str = ""  # file, name or case from which the scene was loaded
    fraction: float = 1.0  # done of loading or starting
    problem: str = ""  # reason why the last request failed
    record: str = ""  # file of the recording, with its folder
    record_state: str = ""  # of the recorder: starting, recording, paused
    record_note: str = ""  # a remark on the file
    record_seconds: float = 0.0  # duration so far
    record_bytes: float = 0.0  # size so far
    record_room_bytes: float = 0.0  # free space
    replay: str = ""  # bag that is played
    replay_as: str = "path"
    replay_state: str = ""
    replay_rate: float = 1.0  # speed factor
    replay_loop: bool = False
    replay_paused: bool = False  # as asked for, also before the replay begins
    position: float = 0.0  # s, in the replay
    duration: float = 0.0  # s

    @property
    def is_busy(self) -> bool:
        """True while a scene loads or nodes start."""
        return self.fraction < 1.0

    @property
    def is_recording(self) -> bool:
        """True while the recorder reports that it writes."""
        return bool(self.record) and self.record_state == "recording"

    @property
    def is_starting(self) -> bool:
        """True from the request of a replay until it plays."""
        return bool(self.replay) and self.replay_state in ("starting", "waiting")

    @property
    def is_playing(self) -> bool:
        """True while the replay goes on, or will go on as soon as it is ready."""
        is_awaited = self.is_starting and not self.replay_paused
        return is_awaited or self.replay_state == "playing"

    @classmethod
    def from_status(cls, status: DiagnosticStatus) -> SessionState:
        """Read the report of `session_control`."""
        texts = {each.key: each.value for each in status.values}
        values: dict[str, Any] = {"is_there": True, "state": texts.get("state", status.message)}
        values["problem"] = status.message if status.level != DiagnosticStatus.OK else ""
        for each in fields(cls):
            text = texts.get(each.name)
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
    """The newest state of the session, and the pages that show it; for any thread.

    Args:
        on_watch: called when the first page shows it, and when the last has gone.
        send: sets parameters of ``session_control`` together; the future holds the refusal, or "".
        folder: in which pages record; "" is the one in which us-sim runs.
        is_own: all pages are of this computer; pages of others may load and play only what is
            listed, and record only in the folder.
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
        """Set parameters of ``session_control``; the future holds the refusal, or ""."""
        refusal = "" if self._is_own else self._find_refusal(values)
        if self._send_to_control is not None and self.state.is_there and not refusal:
            file = values.get("record")
            if self.folder and file:
                values["record"] = str(PurePath(self.folder, str(file)))
            return self._send_to_control(values)
        return make_answer(refusal or NOT_THERE)

    def _find_refusal(self, values: Mapping[str, object]) -> str:
        """Return why a page of another computer may not ask for this; "" if it may."""
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
SILENT_S = 3.0  # without a report, after which us-sim counts as gone: it reports every second


class ViewerSession(SessionBoard):
    """A board that follows the session's topics while a page shows it, and asks `session_control`.

    It calls ``post`` to run a call in the node's thread.
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
            (DiagnosticArray, "diagnostics", self._on_diagnostics, STREAM, False),
            (DiagnosticArray, "session/scenes", self._on_scenes, LATCHED, False),
            (DiagnosticArray, "session/bags", self._on_bags, LATCHED, False),
        )
        self._timer = node.create_timer(_EVERY_S, self._check)
        self._timer.cancel()
        self._client: AsyncParameterClient | None = None
        self._heard = 0.0
        self.on_other_scene: Callable[[], None] = lambda: None
        """Called in the node's thread when another scene is loaded."""

    def _listen(self) -> None:
        if self.is_watched and self._client is None:
            self._client = AsyncParameterClient(self._node, CONTROL)
        if self._subscriptions.set_active(self.is_watched):
            (self._timer.reset if self.is_watched else self._timer.cancel)()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._name:
                self._heard = time.monotonic()
                before, self.state = self.state, SessionState.from_status(status)
                if before.is_there and before.origin != self.state.origin:
                    self.on_other_scene()

    def _on_scenes(self, message: DiagnosticArray) -> None:
        self.scenes = tuple(map(_read_scene, message.status))

    def _on_bags(self, message: DiagnosticArray) -> None:
        self.bags = {loggable_text(status.name): status.hardware_id for status in message.status}

    def _check(self) -> None:
        """Forget the state when us-sim has been silent for long."""
        if self.state.is_there and time.monotonic() - self._heard > SILENT_S:
            self.state = SessionState()

    def _send(self, values: Mapping[str, object]) -> Future[str]:
        if self._client is None:
            return make_answer(NOT_THERE)
        return set_atomically(self._client, [Parameter(n, value=v) for n, v in values.items()])


def _read_scene(status: DiagnosticStatus) -> ListedScene:
    about = {each.key: loggable_text(each.value) for each in status.values}
    is_wrong = status.level != DiagnosticStatus.OK
    message = loggable_text(status.message)
    return ListedScene(
        loggable_text(status.name),
        status.hardware_id,
        about.get("kind", "scene"),
        "" if is_wrong else message,
        about.get("region", ""),
        _read_names(about.get("structures", "")),
        about.get("probe", ""),
        about.get("tracker", ""),
        message if is_wrong else "",
    )


def _read_names(text: str) -> tuple[str, ...]:
    """Read a JSON list of texts; empty if the text is no list."""
    try:
        listed = json.loads(text)
    except (ValueError, RecursionError):
        return ()
    return tuple(map(str, listed)) if isinstance(listed, list) else ()
