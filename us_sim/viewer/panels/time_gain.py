"""The sliders of a console for the gain by depth."""

from __future__ import annotations

import numpy as np
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from us_sim.viewer.panels.parameter_control import Change, tip_of
from us_sim.viewer.parameter_board import ParameterBoard
from us_sim.viewer.parameters import Parameter
from us_sim.viewer.time_gain_sliders import on_sliders, slider_count

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
