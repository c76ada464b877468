"""The parameters of one node in sections, as its descriptors say them: new ones come by themselves.

The controls of a section are made when it is first opened.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from nicegui import ui
from nicegui.element import Element

from us_sim.viewer.panels.controls import Control, ParameterControl, TimeGain
from us_sim.viewer.parameters import NodeParameters, Parameter, ParameterBoard, State, in_words

Arrange = Callable[[Mapping[str, Parameter]], list["Section"]]
"""Puts the parameters of a node, by name, into sections."""


@dataclass(frozen=True)
class Section:
    """Parameters under one title."""

    key: str  # what it is known by while its parameters change
    title: str  # without one it cannot be folded away
    names: tuple[str, ...]
    labels: Mapping[str, str] = field(default_factory=dict)  # in place of the parameters' own
    is_open: bool = False  # at first
    is_shown: bool = True


def common_first(common: tuple[str, ...]) -> Arrange:
    """These first, then the others group by group, and last those fixed at the start.

    Without any of these, the parameters of no group are first.
    """

    def arrange(parameters: Mapping[str, Parameter]) -> list[Section]:
        live = [name for name in parameters if parameters[name].is_live]
        first = tuple(name for name in common if name in live)
        first = first or tuple(name for name in live if not parameters[name].group)
        rest = [name for name in parameters if name not in first]
        sections = [Section("common", "", first)]
        return sections + groups_of(parameters, rest) + given_at_the_start(parameters, rest)

    return arrange


def groups_of(parameters: Mapping[str, Parameter], names: Iterable[str]) -> list[Section]:
    """A section for each group of these names that may change; the rest are "More"."""
    groups: dict[str, list[str]] = {}
    for name in names:
        if parameters[name].is_live:
            groups.setdefault(parameters[name].group, []).append(name)
    return [
        Section(f"group {group}", title_of(group) if group else "More", tuple(members))
        for group, members in sorted(groups.items(), key=lambda each: bool(each[0]))
    ]


def groups_in_use(
    parameters: Mapping[str, Parameter], names: Iterable[str], choosing: Iterable[str]
) -> tuple[list[Section], list[Section]]:
    """The groups of these names: those that belong to a choice, and the others.

    A parameter of ``choosing`` chooses the group that has the name of its value; the groups of its
    other choices are not shown.
    """
    choosing = [name for name in choosing if name in parameters]
    known = {choice for name in choosing for choice in parameters[name].choices}
    in_use = {parameters[name].value for name in choosing}
    belonging, others = [], []
    for section in groups_of(parameters, names):
        group = parameters[section.names[0]].group
        if group in known:
            title = f"Settings of {group}"
            belonging.append(dataclasses.replace(section, title=title, is_shown=group in in_use))
        else:
            others.append(section)
    return belonging, others


def chosen_first(choosing: str) -> Arrange:
    """A choice and the settings of what is chosen, and then all others."""

    def arrange(parameters: Mapping[str, Parameter]) -> list[Section]:
        first = tuple(name for name in (choosing,) if name in parameters)
        rest = [name for name in parameters if name not in first]
        belonging, others = groups_in_use(parameters, rest, first)
        return [
            Section("common", "", first),
            *belonging,
            *others,
            *given_at_the_start(parameters, rest),
        ]

    return arrange


def given_at_the_start(parameters: Mapping[str, Parameter], names: Iterable[str]) -> list[Section]:
    """A section of those that cannot be changed any more, if there are any."""
    fixed = tuple(name for name in names if not parameters[name].is_live)
    labels = {name: in_words(name) for name in fixed}
    return [Section("fixed", "Given at the start", fixed, labels)] if fixed else []


def title_of(group: str) -> str:
    """The title of a group of parameters."""
    words = in_words(group)
    return words[:1].upper() + words[1:]


MakeControl = Callable[[ParameterBoard, Parameter, str], Control]


class ParameterSections:
    """Shows a node's parameters; `refresh` brings them up to date.

    Args:
        board: where parameters are read and set.
        node: its name.
        arrange: puts parameters into sections.
        special: what makes the controls of some parameters, by their names.
    """

    def __init__(
        self,
        board: ParameterBoard,
        node: str,
        arrange: Arrange,
        special: Mapping[str, MakeControl] | None = None,
    ) -> None:
        self._board, self._node, self._arrange = board, node, arrange
        self._special = special or {}
        self._shown: NodeParameters | None = None
        self._sections: dict[str, _ShownSection] = {}
        self._state = ui.label().classes("us-note").props('role="status"')
        self._body = ui.element("div").classes("us-sections")

    def watch(self) -> None:
        """Follow the node's parameters."""
        self._board.watch(self._node)

    def unwatch(self) -> None:
        """Follow them no longer."""
        self._board.unwatch(self._node)

    def refresh(self) -> None:
        """Show what is known now."""
        known = self._board.of(self._node)
        if known is self._shown:
            return
        self._shown = known
        self._state.set_text(f"{self._node} {known.state.value or 'has no parameters'}")
        self._state.set_visibility(known.state is not State.THERE or not known.parameters)
        self._body.set_visibility(bool(known.parameters))
        if known.parameters:
            self._show(known.parameters)

    def _show(self, parameters: Mapping[str, Parameter]) -> None:
        sections = [each for each in self._arrange(parameters) if each.names]
        for key in self._sections.keys() - {section.key for section in sections}:
            self._sections.pop(key).delete()
        for place, section in enumerate(sections):
            shown = self._sections.get(section.key)
            if shown is None:
                with self._body:
                    shown = _ShownSection(self._board, section, self._special)
                self._sections[section.key] = shown
            shown.move(place)
            shown.show(section, parameters)


class _ShownSection:
    def __init__(
        self, board: ParameterBoard, section: Section, special: Mapping[str, MakeControl]
    ) -> None:
        self._board, self._special = board, special
        self._section = section
        self._parameters: Mapping[str, Parameter] = {}
        self._controls: dict[str, Control] = {}
        self._outer: Element
        if section.title:
            expansion = ui.expansion(section.title, value=section.is_open)
            expansion.classes("us-section").props("dense")
            expansion.on_value_change(lambda event: self._open(bool(event.value)))
            self._outer, self._is_open = expansion, section.is_open
        else:
            self._outer, self._is_open = ui.element("div").classes("us-section"), True
        with self._outer:
            self._inner = ui.element("div").classes("us-controls")

    def delete(self) -> None:
        """Take it off the page."""
        self._outer.delete()

    def move(self, place: int) -> None:
        """Stand at a place among the sections."""
        slot = self._outer.parent_slot
        if slot is not None and slot.children.index(self._outer) != place:
            self._outer.move(target_index=place)

    def show(self, section: Section, parameters: Mapping[str, Parameter]) -> None:
        """Show these of the parameters."""
        self._section, self._parameters = section, parameters
        if self._outer.visible != section.is_shown:
            self._outer.set_visibility(section.is_shown)
        if self._is_open and section.is_shown:
            self._fill()

    def _open(self, is_open: bool) -> None:
        self._is_open = is_open
        if is_open:
            self._fill()

    def _fill(self) -> None:
        """Bring the controls up to date; one whose parameter is of another kind is made anew."""
        wanted = {name: self._parameters[name] for name in self._section.names}
        for name, control in list(self._controls.items()):
            if name not in wanted or control.parameter.kind is not wanted[name].kind:
                self._controls.pop(name).delete()
        for place, (name, parameter) in enumerate(wanted.items()):
            if name in self._controls:
                self._controls[name].show(parameter)
                continue
            make = self._special.get(name, ParameterControl)
            with self._inner:
                control = make(self._board, parameter, self._section.labels.get(name, ""))
            if place != len(self._controls):
                control.move(target_index=place)
            self._controls[name] = control
        gains = self._controls.get("time_gain")
        if isinstance(gains, TimeGain) and "depth" in wanted:
            gains.reach(wanted["depth"])
