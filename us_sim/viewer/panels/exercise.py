"""The panel of an exercise: the task, what is done of it, and the metrics so far."""

from __future__ import annotations

from nicegui import ui

from us_sim.viewer.panels.controls import WhileShown
from us_sim.viewer.score import ToldScore
from us_sim.viewer.stream import Simulator

EVERY_S = 0.5
"""How often the panel is brought up to date."""
TITLE = "Exercise"
NOTHING = (
    "No exercise is followed: load a scene that has one, such as upper arm thrombosis, or start "
    "the node scorer."
)


def build_exercise(simulator: Simulator) -> None:
    """Make the panel; every page shows the same, so that a teacher sees what a learner does."""
    board = simulator.score
    drawn = ToldScore(name="not drawn yet")

    def refresh() -> None:
        nonlocal drawn
        told = board.score
        if told == drawn:
            return
        drawn = told
        name.set_text(told.name or TITLE)
        about.set_text(told.description if told.name else NOTHING)
        done = sum(step.is_done for step in told.steps)
        passed = "passed: " if done == len(told.steps) else ""
        result.set_text(f"{passed}{done} of {len(told.steps)} done" if told.steps else "")
        again.set_visibility(bool(told.name))
        steps.clear()
        metrics.clear()
        with steps:
            for step in told.steps:
                with ui.row(wrap=False).classes("us-step"):
                    ui.icon("check_circle" if step.is_done else "radio_button_unchecked")
                    ui.label(f"{'Done' if step.is_done else 'To do'}: {step.what}, {step.seen}")
        with metrics:
            for label, value in told.metrics.items():
                ui.label(label).classes("us-quiet")
                ui.label(value)

    with WhileShown(board.watch, lambda: board.watch(-1), EVERY_S, refresh):
        name = ui.label(TITLE).classes("us-heading").props('role="heading" aria-level="2"')
        about = ui.label().classes("us-note")
        result = ui.label().classes("us-session-state").props('role="status"')
        steps = ui.column().classes("us-steps")
        again = ui.button("Begin anew", on_click=board.clear).props("flat dense no-caps")
        again.props["title"] = "Forget what was done so far"
        with ui.expansion("Score so far").classes("us-cases-more"):
            metrics = ui.grid(columns=2).classes("us-metrics")
