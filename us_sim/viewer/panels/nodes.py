"""Panels of the nodes: the scanner's console, the tissue, and the status of every node."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from nicegui import ui
from nicegui.element import Element

from us_sim.viewer.panels.controls import TimeGainControl, WhileShown
from us_sim.viewer.panels.sections import (
    REFRESH_S,
    ParameterSection,
    arrange_parameters,
    build_parameters,
    format_title,
)
from us_sim.viewer.parameters import Parameter
from us_sim.viewer.status import NodeLevel, NodeStatus
from us_sim.viewer.stream import PageSources

COMMON = ("depth", "gain", "dynamic_range", "focus", "time_gain", "grey_map", "overlay", "contact")
"""Parameters of ``slice_interpolator`` that come first."""
STATUS_S = 0.5  # between two refreshes of the status
TISSUE = "tissue_deformer"
METHOD = ("solver", "compare_with")
MATERIALS, STIFFNESS, PRESSURE = "materials.", ".young_modulus", ".lumen_pressure"
RECENT_S = 20.0  # for which the refusal of a setting is shown
PROBLEM_S = 60.0  # for which the last problem of a node that is well again is shown


def build_image(sources: PageSources) -> None:
    """Build the panel of the scanner's console."""
    console = "", "slice_interpolator", partial(arrange_parameters, first=COMMON)
    build_parameters(sources.nodes, console, special={"time_gain": TimeGainControl})


def arrange_tissue(parameters: Mapping[str, Parameter]) -> list[ParameterSection]:
    """Arrange the method, the settings of the methods in use, stiffness and blood pressure."""

    def labels(ending: str, more: str = "") -> dict[str, str]:
        return {
            name: format_title(name[len(MATERIALS) : -len(ending)]) + more
            for name, parameter in parameters.items()
            if name.startswith(MATERIALS) and name.endswith(ending) and parameter.value is not None
        }

    stiff, pressed = labels(STIFFNESS), labels(PRESSURE, " pressure")
    stiffness = ParameterSection("Young's modulus", tuple(stiff), stiff, is_open=True)
    pressure = ParameterSection("Pressure of blood", tuple(pressed), pressed, is_open=True)
    return arrange_parameters(parameters, choosing=METHOD, ahead=[stiffness, pressure])


def build_tissue(sources: PageSources) -> None:
    """Build the panel of the tissue, with the skin and the tracker."""
    board = sources.status

    def refresh() -> None:
        notes = _list_notes(board.find_node(TISSUE, time.monotonic()))
        for label, text in zip(labels, notes, strict=True):
            label.set_text(text)
            label.set_visibility(bool(text))

    with WhileShown(board.add_page, board.remove_page, REFRESH_S, refresh):
        labels = (
            ui.label().classes("us-note us-accent").props('role="status"'),
            ui.label().classes("us-note"),
            ui.label().classes("us-reason").props('role="alert"'),
        )
    build_parameters(
        sources.nodes,
        ("", TISSUE, arrange_tissue),
        ("Skin", "skin_deformer", arrange_parameters),
        ("Tracker", "probe_tracker", partial(arrange_parameters, choosing=("filter",))),
    )


def _list_notes(status: NodeStatus | None) -> tuple[str, str, str]:
    """Return notes on a method in preparation, the difference of two, and a refused setting."""
    if status is None:
        return "", "", ""
    preparing = status.values.get("preparing", "")
    compared = status.values.get("compared_with", "")
    most, mean = status.read_number("difference_max_mm"), status.read_number("difference_rms_mm")
    difference = ""
    if status.level is not NodeLevel.GONE and compared and most is not None and mean is not None:
        difference = f"{compared} is {most:.3g} mm away at most, {mean:.3g} mm root mean square"
    is_recent = time.monotonic() - status.problem_heard < RECENT_S
    return (
        f"{preparing}: the tissue goes on as it was until then" if preparing else "",
        difference,
        status.problem if is_recent and status.problem_kind == "setting" else "",
    )


def build_status(sources: PageSources) -> None:
    """Build the table of all nodes; a click on one shows its parameters."""
    board = sources.status

    def refresh() -> None:
        now = time.monotonic()
        table.show_nodes(board.list_nodes(now), now)

    with WhileShown(board.add_page, board.remove_page, STATUS_S, refresh):
        table = StatusTable(partial(_show_parameters, sources))


def _show_parameters(sources: PageSources, node: str) -> None:
    """Open a dialog with all parameters of a node."""
    with ui.dialog() as dialog, ui.card().classes("us-dialog"):
        dialog.props["aria-label"] = f"Parameters of {node}"
        with ui.row().classes("us-dialog-head"):
            ui.label(node).classes("us-heading").props('role="heading" aria-level="1"')
            ui.space()
            button = ui.button(icon="close", on_click=dialog.close)
            button.props("flat round dense title=Close aria-label=Close")
        shown = build_parameters(sources.nodes, ("", node, arrange_parameters))

    def close() -> None:
        shown.stop_showing()
        dialog.delete()

    dialog.on("hide", close)
    dialog.open()


class StatusTable(Element, component="status_table.js"):
    """A table of all nodes.

    Args:
        choose: called with the name of a node that a person clicks.
    """

    def __init__(self, choose: Callable[[str], None]) -> None:
        super().__init__()
        self.on("choose", lambda event: choose(str(event.args)))

    def show_nodes(self, nodes: list[NodeStatus], now: float) -> None:
        """Show these nodes; ``now`` is s of the monotonic clock."""
        rows = [make_row(status, now) for status in nodes]
        if rows != self.props.get("rows"):
            self.props["rows"] = rows


def make_row(status: NodeStatus, now: float) -> dict[str, Any]:
    """Make a node's row of the table, as texts."""

    def text(key: str, digits: int = 0) -> str:
        number = status.read_number(key)
        return "" if number is None else f"{number:.{digits}f}"

    def milliseconds(which: str) -> str:
        number = status.read_number(f"latency_{which}_ms") or 0.0
        return text(f"latency_{which}_ms", 1 if abs(number) < 99.95 else 0)

    is_wrong = status.level in (NodeLevel.WARNING, NodeLevel.ERROR)
    age = now - status.problem_heard
    problem = ""
    if status.problem and age <= PROBLEM_S:
        many = f" ({status.problems} so far)" if status.problems > 1 else ""
        problem = ("" if is_wrong else f"{age // 5 * 5:.0f} s ago: ") + status.problem + many
    return {
        "name": status.name,
        "level": status.level.value,
        "state": "silent" if status.level is NodeLevel.GONE else status.state,
        "rate": text("rate_hz", 1),
        "latency": " · ".join(filter(None, map(milliseconds, ("p50", "p99")))),
        "received": text("received"),
        "dropped": text("dropped"),
        "problem": problem,
        "isPast": not is_wrong,
    }
