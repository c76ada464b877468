"""A part of the page that knows whether a person can see it.

The part of a parameter's range that a slider covers: a range may span many decades.

>>> from us_sim.viewer.panels.controls import slider_span
>>> slider_span(-60.0, 60.0, 6.0)
SliderSpan(low=-60.0, high=60.0, step=0.2, is_logarithmic=False)
>>> slider_span(1e-6, 1e10, 12.0)  # kPa
SliderSpan(low=0.12, high=1200.0, step=0.0, is_logarithmic=True)

The control of one parameter, made from what its node says of it.

Gains by depth on the sliders of a console, however many gains the images have.

>>> from us_sim.viewer.panels.controls import on_sliders
>>> on_sliders((0.0, 6.0), 4)
[0.0, 2.0, 4.0, 6.0]

The sliders of a console for the gain by depth.
"""

from __future__ import annotations

import asyncio
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from nicegui import ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from us_sim.viewer.parameters import Kind, Parameter, ParameterBoard


class WhileShown(Element, component="while_shown.js"):
    """What is within is worked for only while it can be seen.

    Args:
        begin: called when a person begins to see it.
        end: called when nobody sees it any more: another tab is chosen, the drawer is closed, or
            the browser has gone.
        every: s between two calls of ``refresh`` while it is seen, the first at once.
        refresh: brings up to date what is shown.
    """

    def __init__(
        self,
        begin: Callable[[], None],
        end: Callable[[], None],
        every: float,
        refresh: Callable[[], None],
    ) -> None:
        super().__init__()
        self.classes("us-while-shown")
        self._begin, self._end, self._refresh = begin, end, refresh
        self._is_shown = False
        with self:
            self._timer = ui.timer(every, refresh, active=False, immediate=True)
        self.on("shown", lambda event: self._show(bool(event.args)))
        self.client.on_disconnect(lambda: self._show(False))
        self.client.on_delete(lambda: self._show(False))
        self.client.on_connect(self._ask)

    def close(self) -> None:
        """It is about to be taken off the page."""
        self._show(False)

    def _ask(self) -> Any:
        """A page that was away for a moment does not know that it was."""
        return self.run_method("again")

    def _show(self, is_shown: bool) -> None:
        if is_shown == self._is_shown:
            return
        self._is_shown = is_shown
        (self._begin if is_shown else self._end)()
        self._timer.active = is_shown
        if is_shown:
            self._refresh()


_BY_FACTORS = 50.0
"""From the smallest number to the largest: beyond, a slider goes by factors."""
_WIDE = 1000.0
"""Likewise: beyond, a slider covers what is near the present value."""
_AROUND = 100.0
"""Times the present value, and a hundredth of it, where a slider goes by factors."""
_ROOM = 4.0
"""Times the present value, where a slider begins at zero."""
_STEPS = 600
_NOTHING = 1e-12
"""Of the range: a smaller value is zero on a slider."""


@dataclass(frozen=True)
class SliderSpan:
    """What a slider covers."""

    low: float
    high: float
    step: float  # 0 where it goes by factors
    is_logarithmic: bool

    def holds(self, value: float | None) -> bool:
        """Whether a value can be shown on it; nothing can."""
        return value is None or self.low <= value <= self.high


def slider_span(
    low: float, high: float, value: float | None, is_whole: bool = False
) -> SliderSpan | None:
    """What a slider covers around a value; None where no slider makes sense.

    Args:
        low, high: the range, in the unit that is shown.
        value: at present; None is nothing.
        is_whole: only whole numbers will do.
    """
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        return None
    if low > 0.0 and high / low > _BY_FACTORS and not is_whole:
        if value and value > 0.0 and high / low > _WIDE:
            low, high = max(low, value / _AROUND), min(high, value * _AROUND)
        return SliderSpan(low, high, 0.0, True)
    reach = max(abs(low), abs(high))
    if value and abs(value) < _NOTHING * reach:
        value = 0.0
    if value and reach > _WIDE * abs(value):
        end = _round_number(_ROOM * abs(value))
        low, high = max(low, -end), min(high, end)
    elif is_whole and value and high - low > _WIDE:
        high = min(high, _round_number(_ROOM * abs(value)))
    if (high - low) / _STEPS < sys.float_info.min:
        return None
    step = 1.0 if is_whole else _round_number((high - low) / _STEPS)
    return SliderSpan(low, high, step, False)


def _round_number(number: float) -> float:
    """The next of 1, 2, 5 times a power of ten that is not smaller."""
    power = 10.0 ** math.floor(math.log10(number))
    factor = next(f for f in (1.0, 2.0, 5.0, 10.0) if f * power >= number * (1.0 - 1e-9))
    return float(f"{factor * power:.6g}")


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


USUAL, MOST = 8, 12


def slider_count(gains: Sequence[float]) -> int:
    """How many sliders: one for each gain where those are as many as fit, else as consoles have."""
    return len(gains) if 2 < len(gains) <= MOST else USUAL


def on_sliders(gains: Sequence[float], count: int) -> list[float]:
    """Gains at evenly spaced depths, linear in between, as so many sliders show them, dB."""
    if not gains:
        return [0.0] * count
    places = np.linspace(0.0, 1.0, len(gains)) if len(gains) > 1 else np.zeros(1)
    shown = np.interp(np.linspace(0.0, 1.0, count), places, np.asarray(gains, dtype=float))
    return [round(float(gain), 6) for gain in shown]


REACH = 20.0
"""dB up and down that the sliders cover, as consoles have it."""


class TimeGain(Element, component="time_gain.js"):
    """One slider for each of some depths.

    Args:
        board: where it is set.
        parameter: a list of gains in dB, from the face to the end of the beams.
        label: in place of the parameter's own.
    """

    def __init__(self, board: ParameterBoard, parameter: Parameter, label: str = "") -> None:
        super().__init__()
        self.parameter = parameter
        self._board = board
        self._change = Change(board, parameter.node, parameter.name)
        self._count = slider_count(parameter.value)
        self.props.update(
            {"label": label or parameter.label, "tip": tip_of(parameter), "reason": "", "seen": 0}
        )
        self.props["data-parameter"] = f"{parameter.node}.{parameter.name}"
        self._name_depths(None)
        self._show()
        self.on("change", self._changed)

    def show(self, parameter: Parameter) -> None:
        """The gains are others now."""
        if parameter != self.parameter:
            self.parameter = parameter
            self.props["reason"] = ""
            self._show()

    def reach(self, depth: Parameter) -> None:
        """The beams end at this depth."""
        self._name_depths(depth)

    def _name_depths(self, depth: Parameter | None) -> None:
        end, unit = (float(depth.value), depth.unit) if depth else (100.0, "%")
        names = [f"{place:.0f} {unit}" for place in np.linspace(0.0, end, self._count)]
        if names != self.props.get("depths"):
            self.props["depths"] = names

    def _show(self) -> None:
        gains = on_sliders(self.parameter.value, self._count)
        self.props.update(
            {
                "gains": gains,
                "unit": self.parameter.unit,
                "low": min(-REACH, *gains),
                "high": max(REACH, *gains),
            }
        )

    async def _changed(self, event: GenericEventArguments) -> None:
        answer = await self._change.want(event.args["value"], int(event.args["turn"]))
        if answer is None or self.is_deleted:
            return
        known = self._board.of(self.parameter.node).parameters.get(self.parameter.name)
        if known is not None:
            self.parameter = known
        self.props["seen"], self.props["reason"] = answer
        self._show()
