"""The one page: header, 3D scene, ultrasound image, and a drawer of panels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from nicegui import ui

from us_sim.viewer.headline import build_headline
from us_sim.viewer.modes import build_modes
from us_sim.viewer.panels import cases, image, plots, session, status, tissue
from us_sim.viewer.simulator import Simulator

__all__ = ["PANELS", "Panel", "build_page"]

_HEAD = """<link rel="stylesheet" href="/us_sim/assets/viewer.css">
<link rel="stylesheet" href="/us_sim/assets/panels.css">
<link rel="stylesheet" href="/us_sim/assets/session.css">"""
_BODY = '<script type="module" src="/us_sim/assets/main.js"></script>'


@dataclass(frozen=True)
class Panel:
    """One tab of the drawer."""

    name: str
    icon: str  # of Material's icons, which NiceGUI brings
    tooltip: str
    build: Callable[[Simulator], None]  # called inside the tab


def _status(simulator: Simulator) -> None:
    status.build(simulator)
    plots.build(simulator)


PANELS = [
    Panel("Image", "contrast", "The scanner's console: depth, gain, focus and more", image.build),
    Panel("Tissue", "layers", "Method, materials, skin and tracker", tissue.build),
    Panel("Cases", "collections", "Scenes and cases to load", cases.build),
    Panel("Session", "radio_button_checked", "Record, and replay recordings", session.build),
    Panel("Status", "monitor_heart", "How every node is, and plots of the last minute", _status),
]


def build_page(simulator: Simulator) -> None:
    """Make the page for one browser."""
    ui.add_head_html(_HEAD)
    ui.add_body_html(_BODY)
    ui.colors(primary="#4fb3bf", dark="#171b1f", dark_page="#0e1113", negative="#e5735c")
    ui.query(".nicegui-content").classes("us-content")
    drawer = _drawer(simulator)
    with ui.header().classes("us-header"):
        ui.label("us_sim").classes("us-brand")
        build_headline(simulator)
        ui.space()
        _block("readout")
        with ui.button(icon="tune", on_click=drawer.toggle).props("flat round dense") as button:
            button.props('aria-label="Panels" id="us-panels"')
            ui.tooltip("Panels: image, tissue, cases, session, status")
    with ui.element("main").classes("us-main"):
        with ui.element("section").classes("us-left").props('aria-label="Patient in 3D"'):
            _block("scene")
            _block("hand")
        with ui.element("section").classes("us-right").props('aria-label="Ultrasound"'):
            build_modes(simulator)
            _block("ultrasound")
            _block("strips")
            _block("image-tools")


def _block(name: str) -> None:
    """An element that a module of the page fills."""
    ui.element("div").props["id"] = name


def _drawer(simulator: Simulator) -> ui.right_drawer:
    drawer = ui.right_drawer(value=False, bordered=True).classes("us-drawer")
    # Quasar would cover the header, with the button that closes it, where a screen is narrow.
    drawer.props("width=380 behavior=desktop")
    with drawer:
        if PANELS:
            with ui.tabs().props("dense no-caps").classes("us-tabs") as tabs:
                for panel in PANELS:
                    with ui.tab(panel.name, icon=panel.icon):
                        ui.tooltip(panel.tooltip)
            with ui.tab_panels(tabs, value=PANELS[0].name).classes("us-panels"):
                for panel in PANELS:
                    with ui.tab_panel(panel.name):
                        panel.build(simulator)
    return drawer
