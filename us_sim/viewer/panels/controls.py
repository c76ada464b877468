"""Controls of parameters, made from the parameters' descriptors.

>>> from us_sim.viewer.panels.controls import resample_gains, choose_slider_span
>>> choose_slider_span(-60.0, 60.0, 6.0)
SliderSpan(low=-60.0, high=60.0, step=0.2, is_logarithmic=False)
>>> choose_slider_span(1e-6, 1e10, 12.0)  # kPa
SliderSpan(low=0.12, high=1200.0, step=0.0, is_logarithmic=True)
>>> resample_gains((0.0, 6.0), 4)
[0.0, 2.0, 4.0, 6.0]
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from nicegui import ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from us_sim.viewer.panels.asking import find_refusal, set_parameter
from us_sim.viewer.parameters import Parameter, ParameterKind
from us_sim.viewer.remote_parameters import NodeParameters


class WhileShown(Element, component="while_shown.js"):
    """A part of the page that is refreshed only while a person can see it.

    Args:
        begin: called when the part comes into view.
        end: called when another tab is chosen, the drawer is closed, or the browser has gone.
        every: s between two calls of ``refresh`` while the part is seen; the first is at once.
        refresh: brings the part up to date.
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
        # A page that was disconnected for a moment does not know that it was.
        self.client.on_connect(lambda: self.run_method("again"))

    def stop_showing(self) -> None:
        """End before the part is removed from the page."""
        self._show(False)

    def _show(self, is_shown: bool) -> None:
        if is_shown == self._is_shown:
            return
        self._is_shown = is_shown
        (self._begin if is_shown else self._end)()
        self._timer.active = is_shown
        if is_shown:
            self._refresh()


_BY_FACTORS = 50.0  # ratio of the range's ends beyond which a slider is logarithmic
_WIDE = 1000.0  # ratio beyond which a slider covers only the surroundings of the present value
_AROUND = 100.0  # factor by which a logarithmic slider goes beyond the present value
_ROOM = 4.0  # factor by which a linear slider goes beyond the present value
_STEPS = 600
_FROM_ZERO = {"mmHg": 30.0}
"""Least reach of a slider, by units that people set in whole numbers."""
_NOTHING = 1e-12  # of the range; a smaller value is zero on a slider


@dataclass(frozen=True)
class SliderSpan:
    """The numbers that a slider covers."""

    low: float
    high: float
    step: float  # 0 for a logarithmic slider
    is_logarithmic: bool

    def has_value(self, value: float | None) -> bool:
        """Return whether the slider can show a value; None, for nothing, it can."""
        return value is None or self.low <= value <= self.high


def choose_slider_span(
    low: float, high: float, value: float | None, is_whole: bool = False, unit: str = ""
) -> SliderSpan | None:
    """Choose the span of a slider around a value; None where no slider makes sense.

    Args:
        low: least valid number.
        high: largest valid number.
        value: present value; None is nothing.
        is_whole: only whole numbers are valid.
        unit: of these numbers.
    """
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        return None
    if unit in _FROM_ZERO:
        present, reach = max(low, value or 0.0), _FROM_ZERO[unit]
        high = min(high, reach if present < reach else _round_up(2.0 * present))
        return SliderSpan(low, high, max(1.0, _round_up((high - low) / _STEPS)), False)
    if low > 0.0 and high / low > _BY_FACTORS and not is_whole:
        if value and value > 0.0 and high / low > _WIDE:
            low, high = max(low, value / _AROUND), min(high, value * _AROUND)
        return SliderSpan(low, high, 0.0, True)
    reach = max(abs(low), abs(high))
    if value and abs(value) < _NOTHING * reach:
        value = 0.0
    if value and reach > _WIDE * abs(value):
        end = _round_up(_ROOM * abs(value))
        low, high = max(low, -end), min(high, end)
    elif is_whole and value and high - low > _WIDE:
        high = min(high, _round_up(_ROOM * abs(value)))
    if (high - low) / _STEPS < sys.float_info.min:
        return None
    step = 1.0 if is_whole else _round_up((high - low) / _STEPS)
    return SliderSpan(low, high, step, False)


def _round_up(number: float) -> float:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(number))
    factor = next(f for f in (1.0, 2.0, 5.0, 10.0) if f * power >= number * (1.0 - 1e-9))
    return float(f"{factor * power:.6g}")


class ParameterControl(Element, component="parameter_control.js"):
    """A slider with a number field, a choice, a switch, or a text; read-only values are shown.

    It sends one value at a time; of several values that wait, the last.

    Args:
        node: the node's parameters.
        parameter: the parameter to control, as it is now.
        label: in place of the parameter's own.
    """

    def __init__(self, node: NodeParameters, parameter: Parameter, label: str = "") -> None:
        super().__init__()
        self.parameter = parameter
        self._node = node
        self._wanted: tuple[Any, int] | None = None  # a value to send, and the page's number of it
        self._is_asking = False
        self._span: SliderSpan | None = None
        self.props.update({"label": label or parameter.label, "tip": describe_parameter(parameter)})
        self.props.update({"reason": "", "seen": 0, "forbidden": find_refusal()})
        self.props["data-parameter"] = f"{parameter.node}.{parameter.name}"
        self.on("change", self._on_change)
        self._show()

    def show_parameter(self, parameter: Parameter) -> None:
        """Show another value, or another range."""
        if parameter == self.parameter:
            return
        if parameter.raw != self.parameter.raw:
            self.props["reason"] = ""  # it was another value's
        self.parameter = parameter
        self._show()

    async def _on_change(self, event: GenericEventArguments) -> None:
        self._wanted = event.args["value"], int(event.args["turn"])
        if self._is_asking:
            return
        self._is_asking = True
        try:
            while self._wanted is not None:
                (value, turn), self._wanted = self._wanted, None
                reason = await set_parameter(self._node, self.parameter.name, value)
        finally:
            self._is_asking = False
        if self.is_deleted:
            return
        self.parameter = self._node.parameters.get(self.parameter.name, self.parameter)
        self.props["seen"], self.props["reason"] = turn, reason
        self._show()

    def _show(self) -> None:
        parameter = self.parameter
        value = parameter.value
        self._choose_span(value)
        span = asdict(self._span) if self._span else None
        self.props.update(
            {
                "kind": parameter.kind.name.lower(),
                "value": list(value) if isinstance(value, tuple) else value,
                "unit": parameter.unit,
                "choices": list(parameter.choices),
                "meanings": dict(parameter.meanings),
                "optional": parameter.may_be_nothing,
                "live": parameter.is_live,
                "tip": describe_parameter(parameter),
                "span": span,
            }
        )
        self.update()

    def _choose_span(self, value: Any) -> None:
        """Choose another span if the value is outside, or at an end where the range goes on."""
        parameter, span = self.parameter, self._span
        low, high, kind = parameter.low, parameter.high, parameter.kind
        is_number = kind in (ParameterKind.NUMBER, ParameterKind.WHOLE)
        if not is_number or low is None or high is None:
            self._span = None
            return
        is_at_end = span is not None and (value == span.low != low or value == span.high != high)
        if span is None or not span.has_value(value) or is_at_end:
            is_whole = kind is ParameterKind.WHOLE
            self._span = choose_slider_span(low, high, value, is_whole, parameter.unit)


def describe_parameter(parameter: Parameter) -> str:
    """Return the description of a parameter, its range, and its full name."""
    unit = f" {parameter.unit}" if parameter.unit else ""
    parts = [parameter.description] if parameter.description else []
    if parameter.low is not None and parameter.high is not None:
        parts.append(f"{parameter.low:g} to {parameter.high:g}{unit}")
    if parameter.may_be_nothing:
        parts.append("empty for none")
    if parameter.kind.is_list:
        parts.append("with commas between")
    if not parameter.is_live:
        parts.append("given at the start")
    parts.append(f"{parameter.node}.{parameter.name}")
    return "; ".join(parts)


def count_sliders(gains: Sequence[float]) -> int:
    """Return one slider for each of 3 to 12 gains, else 8, as consoles have."""
    return len(gains) if 2 < len(gains) <= 12 else 8


def resample_gains(gains: Sequence[float], count: int) -> list[float]:
    """Interpolate gains (dB) at evenly spaced depths to ``count`` sliders."""
    if not gains:
        return [0.0] * count
    places = np.linspace(0.0, 1.0, len(gains)) if len(gains) > 1 else np.zeros(1)
    shown = np.interp(np.linspace(0.0, 1.0, count), places, np.asarray(gains, dtype=float))
    return [round(float(gain), 6) for gain in shown]


class TimeGainControl(ParameterControl, component="time_gain.js"):
    """Sliders for the gain in dB at depths from the probe's face to the end of the beams."""

    REACH = 20.0  # dB up and down that the sliders cover, as on consoles

    def __init__(self, node: NodeParameters, parameter: Parameter, label: str = "") -> None:
        self._count = count_sliders(parameter.value)
        super().__init__(node, parameter, label)
        self.set_end(100.0, "%")

    def set_end(self, end: float, unit: str) -> None:
        """Label the sliders with depths up to the end of the beams."""
        names = [f"{place:.0f} {unit}" for place in np.linspace(0.0, end, self._count)]
        if names != self.props.get("depths"):
            self.props["depths"] = names

    def _show(self) -> None:
        gains = resample_gains(self.parameter.value, self._count)
        low, high = min(-self.REACH, *gains), max(self.REACH, *gains)
        self.props.update({"gains": gains, "unit": self.parameter.unit, "low": low, "high": high})
