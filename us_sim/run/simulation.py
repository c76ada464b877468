"""A simulation whose scene, recording and replay may be changed while it runs."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from us_sim.errors import BagError, SettingsError, UsSimError
from us_sim.nodes.settings import PLAYERS, RECORDER, VIEWER, SessionControlSettings
from us_sim.run.plan import RunRequest, make_plan, require_new
from us_sim.run.supervision import Supervisor, print_above_bar
from us_sim.scene.building import load_path
from us_sim.scene.listing import ListedScene, describe_scene, list_scenes
from us_sim.scene.reading import check_files, load_scene
from us_sim.scene.scene import EXERCISE_PREFIX
from us_sim.share import find_bag, full_path, shared_roots

_BAGS_EVERY_S = 2.0
_BAGS = (".mcap", ".db3")
_MOST_BAGS = 500  # the newest
_OF_SCENE = {"scene", "volume"}
_OF_RECORDER = ("state", "note", "seconds", "bytes", "room_bytes")  # values of its report
_OF_PLAYER = {"replay_rate": "rate", "replay_loop": "loop", "replay_paused": "paused"}
"""Parameters that go on to the node that plays."""


class Simulation:
    """A request and the supervisor of its plan, who gets other plans as `session_control` says.

    Where a plan turns out not to work, the one before runs again.
    """

    def __init__(self, request: RunRequest, supervisor: Supervisor) -> None:
        self._request = request
        self._settled: RunRequest | None = None  # the last with which all nodes were ready
        self._supervisor = supervisor
        self._asked: SessionControlSettings | None = None  # scene that is to be loaded
        origin = request.scene.origin
        first = [] if origin.startswith(EXERCISE_PREFIX) else [describe_scene(origin)]
        self._unlisted = chain(first, list_scenes())  # a lesson stays in its order
        self._listed: dict[str, ListedScene] = {}  # by what loads it
        self._bags_at = 0.0
        self._bags: dict[str, str] = {}
        self._problem = ""
        self._control = supervisor.add_control(
            self.check_request, self.apply_request, self._shown()
        )

    def update(self) -> None:
        """Update as `Supervisor.update`, and continue pending requests.

        Raises:
            UsSimError: a node cannot work, and there is nothing to go back to.
        """
        try:
            self._supervisor.update()
        except UsSimError as error:
            if self._settled is None or self._request is self._settled:
                raise
            self._go_back(str(error))
        if not self._supervisor.waiting:
            self._settled = self._request
            self._list_scenes()
            self._list_bags()
        self._load_scene()
        self._report()

    def check_request(self, wanted: SessionControlSettings, named: Collection[str]) -> None:
        """Raise UsSimError where the parameters ask for something impossible."""
        if _OF_SCENE & set(named):
            check_files(load_scene(wanted.scene, volume=wanted.volume))
            return
        if "record" in named and wanted.record:
            require_new(full_path(wanted.record))
            if self._request.everything or (wanted.replay and wanted.replay_as == "recording"):
                raise SettingsError(
                    f"record: {wanted.record}: a recording is played in place of the simulation; "
                    f"end the replay first"
                )
        if {"replay", "replay_as"} & set(named) and wanted.replay:
            file = find_bag(wanted.replay)
            if wanted.replay_as == "path":
                load_path(self._request.scene, file)
                return
            from us_sim.recording.reader import read_bag  # which takes long to import

            if not read_bag(file).message_count:
                raise BagError(f"{file}: holds no message, so there is nothing to play")
            if self._request.record is not None:
                raise SettingsError(
                    f"replay: {file}: as a recording it takes the place of the simulation, which "
                    f"is being recorded to {self._request.record}: end that first"
                )

    def apply_request(self, wanted: SessionControlSettings, named: Collection[str]) -> None:
        """Begin to do as the parameters say."""
        self._problem = ""
        if _OF_SCENE & set(named):
            self._asked = wanted  # to be loaded after this has been answered
            return
        record = full_path(wanted.record) if wanted.record else None
        request = replace(self._request, record=record, is_changed=True)
        if not wanted.replay:
            request = request.without_replay()
        elif {"replay", "replay_as", *_OF_PLAYER} & set(named):
            playing = {name: getattr(wanted, key) for key, name in _OF_PLAYER.items()}
            request = replace(
                request,
                path=find_bag(wanted.replay),
                everything=wanted.replay_as == "recording",
                playing=playing | {"stay": True},
            )
        self._change(request)
        values: dict[str, object] = {
            name: getattr(wanted, key) for key, name in _OF_PLAYER.items() if key in named
        }
        if "replay_time" in named:
            values["time"] = wanted.replay_time
        elif "replay" in named:
            values["time"] = 0.0
        if values and wanted.replay:
            self._control.set_player_parameters(self._supervisor.plan.player, values)

    def _load_scene(self) -> None:
        """Run the scene that was asked for, if any, in place of that which runs."""
        asked, self._asked = self._asked, None
        if asked is None:
            return
        try:
            scene = load_scene(asked.scene, volume=asked.volume)
            anew = set(self._supervisor.plan.nodes) - {VIEWER}
            self._change(self._request.with_scene(scene), anew)
            print_above_bar(f"loading {scene.name}")
        except UsSimError as error:
            self._problem = f"{error}; {self._request.scene.name} goes on"
            print_above_bar(self._problem)
        self._control.set_state_parameters(self._shown())

    def _change(self, request: RunRequest, anew: Collection[str] = ()) -> None:
        plan = make_plan(request)
        self._request = request
        if anew or plan.processes != self._supervisor.plan.processes:
            self._supervisor.change_plan(plan, anew)

    def _go_back(self, why: str) -> None:
        """Return to the former scene; a recording and a replay ended for it do not come back."""
        assert self._settled is not None
        before = self._settled
        if RECORDER not in self._supervisor.plan.nodes:
            before = replace(before, record=None, is_changed=True)
        if not {*PLAYERS} & {*self._supervisor.plan.nodes}:
            before = before.without_replay()
        self._problem = f"{why}; {before.scene.name} runs as before"
        print_above_bar(self._problem)
        self._settled = self._request = before
        self._supervisor.change_plan(make_plan(before))
        self._control.set_state_parameters(self._shown())

    def _list_scenes(self) -> None:
        """Read one scene more while somebody wants the list; publish it once all are read."""
        if not self._control.is_list_wanted:
            return
        for scene in self._unlisted:
            self._listed.setdefault(scene.origin, scene)
            return
        if self._listed:
            self._control.publish_scenes([*self._listed.values()])
            self._listed.clear()

    def _list_bags(self) -> None:
        now, view = time.monotonic(), self._request.view
        if now - self._bags_at < _BAGS_EVERY_S:
            return
        self._bags_at, bags = now, list_bags(view.recordings if view else None)
        if bags != self._bags:
            self._bags = bags
            self._control.publish_bags(bags)

    def _report(self) -> None:
        request, waiting = self._request, self._supervisor.waiting
        count = len(self._supervisor.plan.nodes)
        ready = count - len(waiting)
        state = f"starting: {ready} of {count} nodes" if waiting else "running"
        if waiting and self._settled is not None and self._settled.scene is not request.scene:
            state += ", no images until all are ready"
        reports, replay = self._supervisor.monitor.reports, self._control.values
        values: dict[str, str] = {
            "scene": request.scene.name,
            "origin": request.scene.origin,
            "volume": request.scene.volume.name,
            "fraction": f"{ready / max(count, 1):.2f}",
            "record": str(full_path(request.record)) if request.record else "",
            "replay": str(request.path or ""),
            "replay_as": "recording" if request.everything else "path",
            "replay_rate": f"{replay.replay_rate:g}",
            "replay_loop": str(replay.replay_loop).lower(),
            "replay_paused": str(replay.replay_paused).lower(),
        }
        if request.record:  # what a recorder said that has ended is no more so
            recorder = {} if RECORDER in waiting else reports.get(RECORDER, {})
            values["record_state"] = "starting"
            values |= {f"record_{key}": recorder[key] for key in _OF_RECORDER if key in recorder}
        if request.path:
            player = reports.get(self._supervisor.plan.player, {})
            values["replay_state"] = player.get("state", "starting")
            values |= {key: player[key] for key in ("position", "duration") if key in player}
        self._control.publish_state(state, values, self._problem)

    def _shown(self) -> SessionControlSettings:
        """Return the control's parameters as things are."""
        request = self._request
        playing: Any = request.playing
        return SessionControlSettings(
            scene=request.scene.origin,
            volume=request.scene.volume.file,
            record=str(request.record) if request.record else None,
            replay=str(request.path) if request.path else None,
            replay_as="recording" if request.everything else "path",
            **{key: playing[name] for key, name in _OF_PLAYER.items() if name in playing},
        )


def list_bags(recordings: str | None = None) -> dict[str, str]:
    """Return bags that can be replayed: files by names, the newest first, installed ones last.

    A bag of several files is one with its folder; each of these files is a bag of its own, too.
    Pages record to the folder ``recordings``, wherever that is.
    """
    here = Path.cwd()
    own = [(here, here), (here / "bags", here)]
    if recordings:
        own.append((full_path(recordings), full_path(recordings).parent))
    bags: dict[str, str] = {}
    for places in (own, [(root / "bags", root / "bags") for root in shared_roots()]):
        found: dict[Path, Path] = {}  # the folder that a bag is named from
        for folder, base in places:
            found |= {each: base for each in folder.glob("*") if each.suffix in _BAGS}
            found |= {each.parent: base for each in folder.glob("*/metadata.yaml")}
        for file in sorted(found, key=_changed_at, reverse=True)[:_MOST_BAGS]:
            if str(file) not in bags.values():
                bags.setdefault(file.relative_to(found[file]).as_posix(), str(file))
    return bags


def _changed_at(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # taken away meanwhile
        return 0.0
