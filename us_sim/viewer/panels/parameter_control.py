"""The control of one parameter, made from what its node says of it."""

from __future__ import annotations

import asyncio
from typing import Any

from nicegui.element import Element
from nicegui.events import GenericEventArguments

from us_sim.viewer.parameter_board import ParameterBoard
from us_sim.viewer.parameters import Kind, Parameter
from us_sim.viewer.slider_span import SliderSpan, slider_span


class Change:
    """Sets a parameter to what a control sends: one change at a time, and of several the last.

    Args:
        board: where it is set.
        node, name: of the parameter.
    """

    def __init__(self, board: ParameterBoard, node: str, name: str) -> None:
        self._board, self._node, self._name = board, node, name
        self._wanted: list[tuple[Any, int]] = []
        self._is_asking = False

    async def want(self, value: Any, turn: int) -> tuple[int, str] | None:
        """The number of the last change, and the reason if it was refused.

        None is returned where another call is asking already, and asks for this one, too.
        """
        self._wanted = [(value, turn)]
        if self._is_asking:
            return None
        self._is_asking = True
        answer = turn, ""
        try:
            while self._wanted:
                value, turn = self._wanted.pop()
                future = self._board.set(self._node, self._name, value)
                answer = turn, await asyncio.wrap_future(future)
        finally:
            self._is_asking = False
        return answer


class ParameterControl(Element, component="parameter_control.js"):
    """A slider with a number field, a choice, a switch, or a text; read-only ones are shown.

    Args:
        board: where the parameter is set.
        parameter: as it is now.
        label: in place of the parameter's own.
    """

    def __init__(self, board: ParameterBoard, parameter: Parameter, label: str = "") -> None:
        super().__init__()
        self.parameter = parameter
        self._label = label or parameter.label
        self._change = Change(board, parameter.node, parameter.name)
        self._board = board
        self._span: SliderSpan | None = None
        self.props["reason"], self.props["seen"] = "", 0
        self._show()
        self.props["data-parameter"] = f"{parameter.node}.{parameter.name}"
        self.on("change", self._changed)

    def show(self, parameter: Parameter) -> None:
        """The parameter is something else now."""
        if parameter == self.parameter:
            return
        if parameter.raw != self.parameter.raw:
            self.props["reason"] = ""  # of another value
        self.parameter = parameter
        self._show()

    def _show(self) -> None:
        parameter = self.parameter
        value = parameter.value
        self._fit(value)
        span = self._span
        self.props.update(
            {
                "label": self._label,
                "kind": parameter.kind.value,
                "value": list(value) if isinstance(value, tuple) else value,
                "unit": parameter.unit,
                "choices": list(parameter.choices),
                "meanings": dict(parameter.meanings),
                "optional": parameter.may_be_nothing,
                "live": parameter.is_live,
                "tip": tip_of(parameter),
                "span": span
                and {
                    "low": span.low,
                    "high": span.high,
                    "step": span.step,
                    "isLogarithmic": span.is_logarithmic,
                },
            }
        )
        self.update()

    def _fit(self, value: Any) -> None:
        """Have the slider cover the value, with room to go on where the range has some."""
        low, high = self.parameter.low, self.parameter.high
        if self.parameter.kind not in (Kind.NUMBER, Kind.WHOLE) or low is None or high is None:
            self._span = None
            return
        span = self._span
        is_at_the_end = span is not None and (
            (value == span.low != low) or (value == span.high != high)
        )
        if span is None or not span.holds(value) or is_at_the_end:
            self._span = slider_span(low, high, value, self.parameter.kind is Kind.WHOLE)

    async def _changed(self, event: GenericEventArguments) -> None:
        answer = await self._change.want(event.args["value"], int(event.args["turn"]))
        if answer is None or self.is_deleted:
            return
        turn, reason = answer
        known = self._board.of(self.parameter.node).parameters.get(self.parameter.name)
        if known is not None:
            self.parameter = known
        self.props["seen"], self.props["reason"] = turn, reason
        self._show()


def tip_of(parameter: Parameter) -> str:
    """What it is, from where to where it can be set, and what it is called."""
    unit = f" {parameter.unit}" if parameter.unit else ""
    said = [parameter.description] if parameter.description else []
    if parameter.low is not None and parameter.high is not None:
        said.append(f"{parameter.low:g} to {parameter.high:g}{unit}")
    if parameter.may_be_nothing:
        said.append("empty for none")
    if parameter.kind.is_list:
        said.append("with commas between")
    if not parameter.is_live:
        said.append("given at the start")
    said.append(f"{parameter.node}.{parameter.name}")
    return "; ".join(said)
