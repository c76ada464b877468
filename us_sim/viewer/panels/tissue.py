"""The tissue: its method and the method's settings, its materials, the skin, and the tracker."""

from __future__ import annotations

import time
from collections.abc import Mapping

from nicegui import ui

from us_sim.viewer.panels.parameter_sections import ParameterSections
from us_sim.viewer.panels.section import (
    Arrange,
    Section,
    chosen_first,
    common_first,
    given_at_the_start,
    groups_in_use,
    title_of,
)
from us_sim.viewer.panels.while_shown import WhileShown
from us_sim.viewer.parameters import Parameter
from us_sim.viewer.simulator import Simulator
from us_sim.viewer.status import Level, NodeStatus

NODE, SKIN, TRACKER = "tissue_deformer", "skin_deformer", "probe_tracker"
METHOD = ("solver", "compare_with")
MATERIALS, STIFFNESS = "materials.", ".young_modulus"
EVERY_S = 0.2
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


def build(simulator: Simulator) -> None:
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

    with WhileShown(begin, end, EVERY_S, refresh):
        state = ui.label().classes("us-note us-accent").props('role="status"')
        difference = ui.label().classes("us-note")
        problem = ui.label().classes("us-reason").props('role="alert"')
        for title, node, arrange in (
            ("", NODE, arrange_tissue),
            ("Skin", SKIN, common_first(())),
            ("Tracker", TRACKER, chosen_first("filter")),
        ):
            parts.append(_part(simulator, title, node, arrange))


def _part(simulator: Simulator, title: str, node: str, arrange: Arrange) -> ParameterSections:
    if title:
        ui.label(title).classes("us-heading").props('role="heading" aria-level="2"')
    return ParameterSections(simulator.nodes, node, arrange)


def _say(simulator: Simulator, state: ui.label, difference: ui.label, problem: ui.label) -> None:
    """What is being prepared, how far two methods are apart, and what was set back."""
    now = time.monotonic()
    status = simulator.status.node(NODE, now)
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
