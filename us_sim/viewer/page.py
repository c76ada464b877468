"""The one page: header, 3D scene, ultrasound image, and panels that can be opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from nicegui import ui

from us_sim.viewer.headline import build_headline
from us_sim.viewer.modes import build_modes
from us_sim.viewer.panels import cases, image, plots, session, status, tissue
from us_sim.viewer.simulator import Simulator

_HEAD = """<link rel="stylesheet" href="/us_sim/assets/viewer.css">
<link rel="stylesheet" href="/us_sim/assets/panels.css">
<link rel="stylesheet" href="/us_sim/assets/session.css">"""
_BODY = '<script type="module" src="/us_sim/assets/main.js"></script>'


@dataclass(frozen=True)
class Panel:
    """One tab of the panels."""

    name: str
    icon: str  # of Material's icons, which NiceGUI brings
    title: str
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
    with ui.header(wrap=False).classes("us-header"):
        ui.label("us_sim").classes("us-brand").props("role=heading aria-level=1")
        build_headline(simulator)
        ui.space()
        _block("readout")
        button = ui.button(icon="tune").props("flat round dense id=us-panels")
    with ui.element("div").classes("us-main"):  # the page's <main> is Quasar's
        with _section("us-left", "Patient in 3D"):
            _block("scene")
            _block("hand")
        with _section("us-right", "Ultrasound"):
            build_modes(simulator)
            _block("ultrasound")
            _block("strips")
            _block("image-tools")
        with _section("us-drawer", "Panels") as drawer:
            _panels(simulator)
    drawer.set_visibility(False)
    button.props["title"] = "Panels: image, tissue, cases, session, status"
    button.props["aria-label"] = "Panels"
    button.props["aria-expanded"] = "false"

    def toggle() -> None:
        drawer.set_visibility(not drawer.visible)
        button.props["aria-expanded"] = str(drawer.visible).lower()

    button.on_click(toggle)


def _block(name: str) -> None:
    """An element that a module of the page fills."""
    ui.element("div").props["id"] = name


def _section(name: str, label: str) -> ui.element:
    """A part of the page that assistive technology lists by its label."""
    section = ui.element("section")
    section.classes.append(name)
    section.props["aria-label"] = label
    return section


def _panels(simulator: Simulator) -> None:
    with ui.tabs().props("dense no-caps").classes("us-tabs") as tabs:
        for panel in PANELS:
            ui.tab(panel.name, icon=panel.icon).props["title"] = panel.title
    with ui.tab_panels(tabs, value=PANELS[0].name).classes("us-panels"):
        for panel in PANELS:
            with ui.tab_panel(panel.name):
                panel.build(simulator)
