"""The header's words: which scene runs, and what is being done with it."""

from __future__ import annotations

import time
from pathlib import PurePath

from nicegui import ui

from us_sim.viewer.session import SessionState
from us_sim.viewer.simulator import Simulator

_LOOK_S = 0.5


def words_of(state: SessionState) -> tuple[str, str]:
    """The scene's name, and what is to be known of it; the second is often nothing.

    >>> words_of(SessionState(is_there=True, scene="upper_arm", state="running"))
    ('upper arm', '')
    >>> words_of(SessionState(is_there=True, scene="upper_arm", state="starting", fraction=0.4))
    ('upper arm', 'starting, 40 %')
    >>> replay = {"replay": "/home/a/press.mcap", "replay_state": "finished"}
    >>> words_of(SessionState(is_there=True, scene="upper_arm", record="/home/a/b.mcap", **replay))
    ('upper arm', 'recording b.mcap · replay of press.mcap: finished')
    """
    name = state.scene.replace("_", " ")
    if state.is_busy:
        return name, f"{state.state}, {100 * state.fraction:.0f} %"
    parts = [f"recording {PurePath(state.record).name}"] if state.record else []
    if state.replay:
        parts.append(f"replay of {PurePath(state.replay).name}: {state.replay_state}")
    return name, " · ".join(filter(None, parts))


def build_headline(simulator: Simulator) -> None:
    """Make it inside the header."""
    board, nodes = simulator.session, simulator.status
    name = ui.label().classes("us-scene-name").props('id="us-scene"')
    words = ui.label().classes("us-headline").props('role="status"')
    problem = ui.label().classes("us-headline us-wrong").props('role="alert"')

    def look() -> None:
        scene, told = words_of(board.state)
        name.set_text(scene)
        if name.props.get("data-scene") != board.state.scene:
            name.props["data-scene"] = board.state.scene  # as the headers of images say it
            name.update()
        known = (each.values.get("preparing", "") for each in nodes.nodes(time.monotonic()))
        words.set_text(" · ".join(filter(None, (*known, told))))
        problem.set_text(board.state.problem)

    board.watch()
    nodes.watch(pages=1)
    ui.context.client.on_delete(board.unwatch)
    ui.context.client.on_delete(lambda: nodes.watch(pages=-1))
    ui.timer(_LOOK_S, look)
