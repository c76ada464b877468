"""How every node is; choosing one shows its parameters."""

from __future__ import annotations

import time

from nicegui import ui

from us_sim.viewer.panels.parameter_sections import ParameterSections
from us_sim.viewer.panels.section import common_first
from us_sim.viewer.panels.status_table import StatusTable
from us_sim.viewer.panels.while_shown import WhileShown
from us_sim.viewer.simulator import Simulator

EVERY_S = 0.5
PARAMETERS_S = 0.2


def build(simulator: Simulator) -> None:
    """Make the panel."""
    board = simulator.status

    def refresh() -> None:
        now = time.monotonic()
        table.show(board.nodes(now), now)

    with WhileShown(lambda: board.watch(pages=1), lambda: board.watch(pages=-1), EVERY_S, refresh):
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
