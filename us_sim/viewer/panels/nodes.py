"""The scanner's console: what a sonographer sets, the common first.

The tissue: its method and the method's settings, its materials, the skin, and the tracker.

Rates, latencies, the force and the residual over the last minute.

A table of all nodes, and how each is.

How every node is; choosing one shows its parameters.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from nicegui import ui
from nicegui.element import Element

from us_sim.viewer.panels.controls import TimeGain, WhileShown
from us_sim.viewer.panels.sections import (
    Arrange,
    ParameterSections,
    Section,
    chosen_first,
    common_first,
    given_at_the_start,
    groups_in_use,
    title_of,
)
from us_sim.viewer.parameters import Parameter
from us_sim.viewer.status import HISTORY_S, Level, NodeStatus, Point, StatusBoard
from us_sim.viewer.stream import Simulator

SCANNER = "slice_interpolator"
COMMON = (
    "depth",
    "gain",
    "dynamic_range",
    "focus",
    "time_gain",
    "grey_map",
    "overlay",
    "contact",
)
PARAMETERS_S = 0.2
"""How often it is looked whether a parameter was changed elsewhere."""


def build_image(simulator: Simulator) -> None:
    """Make the panel."""
    shown = WhileShown(
        lambda: sections.watch(),
        lambda: sections.unwatch(),
        PARAMETERS_S,
        lambda: sections.refresh(),
    )
    with shown:
        sections = ParameterSections(
            simulator.nodes, SCANNER, common_first(COMMON), {"time_gain": TimeGain}
        )


TISSUE, SKIN, TRACKER = "tissue_deformer", "skin_deformer", "probe_tracker"
METHOD = ("solver", "compare_with")
MATERIALS, STIFFNESS = "materials.", ".young_modulus"
RECENT_S = 20.0
"""How long it is said that a setting was set back."""


def arrange_tissue(parameters: Mapping[str, Parameter]) -> list[Section]:
    """The method, the settings of those in use, the structures' stiffness, and their materials."""
    methods = tuple(name for name in METHOD if name in parameters)
    stiffness = tuple(
        name for name in parameters if name.startswith(MATERIALS) and name.endswith(STIFFNESS)
    )
    rest = [name for name in parameters if name not in methods + stiffness]
    of_methods, others = groups_in_use(parameters, rest, methods)
    labels = {name: title_of(name[len(MATERIALS) : -len(STIFFNESS)]) for name in stiffness}
    materials = [group for group in others if group.names[0].startswith(MATERIALS)]
    return [
        Section("method", "", methods),
        *of_methods,
        Section("stiffness", "Young's modulus", stiffness, labels, is_open=True),
        *materials,
        *(group for group in others if group not in materials),
        *given_at_the_start(parameters, rest),
    ]


def build_tissue(simulator: Simulator) -> None:
    """Make the panel."""
    parts: list[ParameterSections] = []

    def begin() -> None:
        simulator.status.watch(pages=1)
        for part in parts:
            part.watch()

    def end() -> None:
        simulator.status.watch(pages=-1)
        for part in parts:
            part.unwatch()

    def refresh() -> None:
        for part in parts:
            part.refresh()
        _say(simulator, state, difference, problem)

    with WhileShown(begin, end, PARAMETERS_S, refresh):
        state = ui.label().classes("us-note us-accent").props('role="status"')
        difference = ui.label().classes("us-note")
        problem = ui.label().classes("us-reason").props('role="alert"')
        for title, node, arrange in (
            ("", TISSUE, arrange_tissue),
            ("Skin", SKIN, common_first(())),
            ("Tracker", TRACKER, chosen_first("filter")),
        ):
            parts.append(_sections_of(simulator, title, node, arrange))


def _sections_of(
    simulator: Simulator, title: str, node: str, arrange: Arrange
) -> ParameterSections:
    if title:
        ui.label(title).classes("us-heading").props('role="heading" aria-level="2"')
    return ParameterSections(simulator.nodes, node, arrange)


def _say(simulator: Simulator, state: ui.label, difference: ui.label, problem: ui.label) -> None:
    """What is being prepared, how far two methods are apart, and what was set back."""
    now = time.monotonic()
    status = simulator.status.node(TISSUE, now)
    preparing = status.values.get("preparing", "") if status else ""
    _set(state, f"{preparing}: the tissue goes on as it was until then" if preparing else "")
    _set(difference, _difference(status) if status else "")
    is_recent = status is not None and now - status.problem_heard < RECENT_S
    is_about_settings = status is not None and status.problem_kind == "setting"
    _set(problem, status.problem if status and is_recent and is_about_settings else "")


def _difference(status: NodeStatus) -> str:
    compared = status.values.get("compared_with", "")
    most, mean = status.number("difference_max_mm"), status.number("difference_rms_mm")
    if status.level is Level.GONE or not compared or most is None or mean is None:
        return ""
    return f"{compared} is {most:.3g} mm away at most, {mean:.3g} mm root mean square"


def _set(label: ui.label, text: str) -> None:
    if label.text != text:
        label.set_text(text)
    if label.visible != bool(text):
        label.set_visibility(bool(text))


STATUS_S = 0.5
HELD_BACK_S = 0.15
"""The newest force is left for the next turn: until then a larger one may take its place."""

Series = dict[str, list[Point]]


class Plot(Element, component="plot.js"):
    """One quantity over time.

    Args:
        title: of the quantity.
        unit: of its values.
        history: its values after a time, by nodes.
        is_logarithmic: drawn by decades.
    """

    def __init__(
        self, title: str, unit: str, history: Callable[[float], Series], is_logarithmic: bool
    ) -> None:
        super().__init__()
        self.props.update({"title": title, "unit": unit, "logarithmic": is_logarithmic})
        self._history = history
        self._told: dict[str, float] = {}

    def begin(self) -> None:
        """It begins to be shown, with nothing drawn."""
        self._told = {}

    def refresh(self, now: float) -> None:
        """Send what is new; ``now`` is s of the monotonic clock."""
        is_first = not self._told
        oldest = now - HISTORY_S
        history = self._history(min(self._told.values(), default=oldest) if self._told else oldest)
        new = []
        for name, points in history.items():
            fresh = [
                (round(t, 3), value) for t, value in points if t > self._told.get(name, oldest)
            ]
            if fresh:
                self._told[name] = points[-1][0]
                new.append((name, fresh))
        self.run_method("add", round(now, 3), new, is_first)


def build_plots(simulator: Simulator) -> None:
    """Make the panel."""
    board = simulator.status
    plots: list[Plot] = []

    def begin() -> None:
        board.watch(pages=1, plots=1)
        for plot in plots:
            plot.begin()

    def refresh() -> None:
        now = time.monotonic()
        for plot in plots:
            plot.refresh(now)

    with WhileShown(begin, lambda: board.watch(pages=-1, plots=-1), STATUS_S, refresh):
        plots += [
            Plot("rate", "Hz", _of(board, "rate_hz"), False),
            Plot("latency, median", "ms", _of(board, "latency_p50_ms"), False),
            Plot("contact force", "N", _force(board), False),
            Plot("residual", "of the force", _of(board, "residual"), True),
        ]


def _of(board: StatusBoard, key: str) -> Callable[[float], Series]:
    return lambda since: board.history(key, since)


def _force(board: StatusBoard) -> Callable[[float], Series]:
    def history(since: float) -> Series:
        settled = time.monotonic() - HELD_BACK_S
        points = [point for point in board.forces(since) if point[0] < settled]
        return {"probe": points} if points else {}

    return history


PROBLEM_S = 60.0
"""How long the last problem of a node that is well again is shown."""


class StatusTable(Element, component="status_table.js"):
    """The table.

    Args:
        choose: called with the name of a node that a person has chosen.
    """

    def __init__(self, choose: Callable[[str], None]) -> None:
        super().__init__()
        self.on("choose", lambda event: choose(str(event.args)))

    def show(self, nodes: list[NodeStatus], now: float) -> None:
        """Show these nodes; ``now`` is s of the monotonic clock."""
        rows = [row_of(status, now) for status in nodes]
        if rows != self.props.get("rows"):
            self.props["rows"] = rows


def row_of(status: NodeStatus, now: float) -> dict[str, Any]:
    """What the table shows of a node, as texts."""
    latency = [status.number(f"latency_{which}_ms") for which in ("p50", "p99")]
    return {
        "name": status.name,
        "level": status.level.value,
        "state": "silent" if status.level is Level.GONE else status.state,
        "rate": "" if status.rate is None else f"{status.rate:.1f}",
        "latency": " · ".join(_milliseconds(each) for each in latency if each is not None),
        "received": "" if status.received is None else str(status.received),
        "dropped": "" if status.dropped is None else str(status.dropped),
        "problem": _problem(status, now),
        "isPast": status.level not in (Level.WARNING, Level.ERROR),
    }


def _milliseconds(number: float) -> str:
    return f"{number:.1f}" if abs(number) < 99.95 else f"{number:.0f}"


def _problem(status: NodeStatus, now: float) -> str:
    """The last sentence that something was wrong, how long ago, and of how many."""
    age = now - status.problem_heard
    if not status.problem or age > PROBLEM_S:
        return ""
    many = f" ({status.problems} so far)" if status.problems > 1 else ""
    ago = "" if status.level in (Level.WARNING, Level.ERROR) else f"{age // 5 * 5:.0f} s ago: "
    return f"{ago}{status.problem}{many}"


def build_status(simulator: Simulator) -> None:
    """Make the panel."""
    board = simulator.status

    def refresh() -> None:
        now = time.monotonic()
        table.show(board.nodes(now), now)

    with WhileShown(lambda: board.watch(pages=1), lambda: board.watch(pages=-1), STATUS_S, refresh):
        table = StatusTable(lambda node: _show_parameters(simulator, node))


def _show_parameters(simulator: Simulator, node: str) -> None:
    """A dialog with all parameters of a node, until it is closed."""
    with ui.dialog() as dialog, ui.card().classes("us-dialog"):
        dialog.props["aria-label"] = f"Parameters of {node}"
        with ui.row().classes("us-dialog-head"):
            ui.label(node).classes("us-heading").props('role="heading" aria-level="1"')
            ui.space()
            button = ui.button(icon="close", on_click=dialog.close)
            button.props("flat round dense title=Close aria-label=Close")
        shown = WhileShown(
            lambda: sections.watch(),
            lambda: sections.unwatch(),
            PARAMETERS_S,
            lambda: sections.refresh(),
        )
        with shown:
            sections = ParameterSections(simulator.nodes, node, common_first(()))

    def close() -> None:
        shown.close()
        dialog.delete()

    dialog.on("hide", close)
    dialog.open()
