"""The scanner's console: what a sonographer sets, the common first."""

from __future__ import annotations

from us_sim.viewer.panels.parameter_sections import ParameterSections
from us_sim.viewer.panels.section import common_first
from us_sim.viewer.panels.time_gain import TimeGain
from us_sim.viewer.panels.while_shown import WhileShown
from us_sim.viewer.simulator import Simulator

NODE = "slice_interpolator"
COMMON = (
    "depth",
    "gain",
    "dynamic_range",
    "focus",
    "time_gain",
    "grey_map",
    "overlay",
    "contact",
)
EVERY_S = 0.2
"""How often it is looked whether a parameter was changed elsewhere."""


def build(simulator: Simulator) -> None:
    """Make the panel."""
    shown = WhileShown(
        lambda: sections.watch(),
        lambda: sections.unwatch(),
        EVERY_S,
        lambda: sections.refresh(),
    )
    with shown:
        sections = ParameterSections(
            simulator.nodes, NODE, common_first(COMMON), {"time_gain": TimeGain}
        )
