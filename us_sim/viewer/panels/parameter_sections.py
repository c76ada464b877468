"""The parameters of one node in sections, as its descriptors say them: new ones come by themselves.

A section's controls are made when it is opened first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from nicegui import ui
from nicegui.element import Element

from us_sim.viewer.panels.parameter_control import ParameterControl
from us_sim.viewer.panels.section import Arrange, Section
from us_sim.viewer.panels.time_gain import TimeGain
from us_sim.viewer.parameter_board import ParameterBoard
from us_sim.viewer.parameters import NodeParameters, Parameter, State

Control = ParameterControl | TimeGain
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
        """Somebody begins to look."""
        self._board.watch(self._node)

    def unwatch(self) -> None:
        """Nobody looks any more."""
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
    """One section on the page."""

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
        if "time_gain" in self._controls and "depth" in wanted:
            control = self._controls["time_gain"]
            if isinstance(control, TimeGain):
                control.reach(wanted["depth"])
