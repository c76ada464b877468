"""The session as pages see it: what runs, what can be loaded and played, and how to ask for it.

>>> from us_sim.viewer.session import SessionBoard
>>> board = SessionBoard()
>>> board.state.is_there, board.ask(record="a.mcap").result()
(False, 'us-sim does not run this simulation, so nothing can be loaded or recorded from here')
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import PurePath

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
