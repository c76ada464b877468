"""The parameters of nodes in sections, from the descriptors: new parameters need no code here.

The controls of a section are built when it is first opened.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from nicegui import ui
from nicegui.element import Element

from us_sim.viewer.panels.controls import ParameterControl, TimeGainControl, WhileShown
from us_sim.viewer.parameters import Parameter, format_name
from us_sim.viewer.remote_parameters import THERE, NodeParameters, RemoteParameters

REFRESH_S = 0.2  # between two refreshes


@dataclass(frozen=True)
class ParameterSection:
    """Parameters under one title."""

    title: str  # "" for a section that cannot be closed
    names: tuple[str, ...]
    labels: Mapping[str, str] = field(default_factory=dict)  # in place of the parameters' own
    is_open: bool = False  # when it is first shown
    is_shown: bool = True


Arrange = Callable[[Mapping[str, Parameter]], list[ParameterSection]]
"""Puts the parameters of a node, by name, into sections."""


def arrange_parameters(
    parameters: Mapping[str, Parameter],
    first: Sequence[str] = (),
    choosing: Sequence[str] = (),
    ahead: Sequence[ParameterSection] = (),
) -> list[ParameterSection]:
    """Arrange parameters in sections: some first, the others by groups, last the fixed ones.

    Args:
        parameters: of a node, by name.
        first: names that come first; without any, the parameters of no group come first.
        choosing: names that come next; each value is the name of a group to show, and the groups of
            the other choices are hidden.
        ahead: sections that come before those of the groups.
    """
    live = [name for name in parameters if parameters[name].is_live]
    top = [name for name in (*first, *choosing) if name in live]
    top = top or [name for name in live if not parameters[name].group]
    taken = {*top, *(name for section in ahead for name in section.names)}
    groups: dict[str, list[str]] = {"": []}
    for name in live:
        if name not in taken:
            groups.setdefault(parameters[name].group, []).append(name)
    chosen, others = [], []
    deciding = [parameters[name] for name in choosing if name in parameters]
    for group, names in groups.items():
        if any(group in each.choices for each in deciding):
            is_shown = any(group == each.value for each in deciding)
            title = f"Settings of {group}"
            chosen.append(ParameterSection(title, tuple(names), is_shown=is_shown))
        else:
            others.append(ParameterSection(format_title(group) or "More", tuple(names)))
    # The header has the scene, which would name an examination's arm.
    fixed = {name: format_name(name) for name in parameters if name not in (*live, "scene")}
    last = ParameterSection("Given at the start", tuple(fixed), fixed)
    sections = [ParameterSection("", tuple(top)), *chosen, *ahead, *others, last]
    return [section for section in sections if section.names]


def format_title(group: str) -> str:
    """Write the title of a group of parameters, with a capital."""
    words = format_name(group)
    return words[:1].upper() + words[1:]


class ParameterSections:
    """Shows a node's parameters; `refresh_sections` brings them up to date.

    Args:
        node: the node's parameters.
        arrange: puts them into sections.
        special: classes of the controls of some parameters, by name.
    """

    def __init__(
        self, node: NodeParameters, arrange: Arrange, special: Mapping[str, type[ParameterControl]]
    ) -> None:
        self.node, self._arrange, self._special = node, arrange, special
        self._seen: tuple[str, Mapping[str, Parameter]] | None = None
        self._layout: object = None  # of the built sections
        self._is_open: dict[str, bool] = {}  # by title
        self._boxes: dict[str, Element] = {}  # by title
        self._controls: dict[str, ParameterControl] = {}
        self._state = ui.label().classes("us-note").props('role="status"')
        self._body = ui.element("div").classes("us-sections")

    def refresh_sections(self) -> None:
        """Show the present parameters."""
        state, parameters = seen = self.node.state, self.node.parameters
        if self._seen is not None and state == self._seen[0] and parameters is self._seen[1]:
            return
        self._seen = seen
        self._state.set_text(f"{self.node.name} {state or 'has no parameters'}")
        self._state.set_visibility(state != THERE or not parameters)
        self._body.set_visibility(bool(parameters))
        if parameters:
            self._show(parameters)

    def _show(self, parameters: Mapping[str, Parameter]) -> None:
        sections = self._arrange(parameters)
        kinds = {name: parameter.kind for name, parameter in parameters.items()}
        layout = kinds, [(section.title, section.names) for section in sections]
        if layout != self._layout:
            self._layout = layout
            self._body.clear()
            self._controls = {}
            with self._body:
                self._boxes = {section.title: self._build(section) for section in sections}
        for section in sections:
            box = self._boxes[section.title]
            if box.visible != section.is_shown:
                box.set_visibility(section.is_shown)
        for name, control in self._controls.items():
            control.show_parameter(parameters[name])
        self._name_depths()

    def _build(self, section: ParameterSection) -> Element:
        """Build a section, with its controls if it is open."""
        box: Element

        def fill() -> None:
            if inner.default_slot.children:
                return
            with inner:
                for name in section.names:
                    make = self._special.get(name, ParameterControl)
                    parameter = self.node.parameters[name]
                    control = make(self.node, parameter, section.labels.get(name, ""))
                    self._controls[name] = control
            self._name_depths()

        def on_change(is_open: bool) -> None:
            self._is_open[section.title] = is_open
            if is_open:
                fill()

        is_open = self._is_open.get(section.title, section.is_open)
        if section.title:
            box = ui.expansion(section.title, value=is_open).props("dense")
            box.on_value_change(lambda event: on_change(bool(event.value)))
        else:
            box, is_open = ui.element("div"), True
        with box.classes("us-section"):
            inner = ui.element("div").classes("us-controls")
        if is_open:
            fill()
        return box

    def _name_depths(self) -> None:
        """Label the sliders of the time gain with depths up to the image's."""
        gains, depth = self._controls.get("time_gain"), self.node.parameters.get("depth")
        if isinstance(gains, TimeGainControl) and depth is not None:
            gains.set_end(float(depth.value), depth.unit)


def build_parameters(
    nodes: RemoteParameters,
    *wanted: tuple[str, str, Arrange],
    special: Mapping[str, type[ParameterControl]] | None = None,
) -> WhileShown:
    """Build the sections of some nodes, followed while a person can see them.

    Args:
        nodes: the parameters of all nodes.
        *wanted: title, name and arrangement of each node to show.
        special: as for `ParameterSections`.
    """
    made: list[ParameterSections] = []

    def begin() -> None:
        for each in made:
            each.node.add_page()

    def end() -> None:
        for each in made:
            each.node.remove_page()

    def refresh() -> None:
        for each in made:
            each.refresh_sections()

    with WhileShown(begin, end, REFRESH_S, refresh) as shown:
        for title, name, arrangement in wanted:
            if title:
                ui.label(title).classes("us-heading").props('role="heading" aria-level="2"')
            made.append(ParameterSections(nodes.get_node(name), arrangement, special or {}))
    return shown
