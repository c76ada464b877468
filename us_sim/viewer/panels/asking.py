"""Requests of a page to nodes and to the session; a page that only watches is refused."""

from __future__ import annotations

from typing import Any

from nicegui import ui
from nicegui.elements.mixins.disableable_element import DisableableElement

from us_sim.viewer.remote_parameters import NodeParameters, await_answer
from us_sim.viewer.session import CONTROL, SessionBoard
from us_sim.viewer.stream import ONLY_WATCHES


def find_refusal() -> str:
    """Return why the page may change nothing; "" if it may."""
    request = ui.context.client.request
    return ONLY_WATCHES if request is not None and "watch" in request.query_params else ""


def enable_control(control: DisableableElement, is_on: bool = True) -> None:
    """Enable or disable a control; a page that only watches has it disabled, with the reason."""
    reason = find_refusal()
    control.set_enabled(is_on and not reason)
    if reason and control.props.get("title") != reason:
        control.props["title"] = reason


async def set_parameter(node: NodeParameters, name: str, value: Any) -> str:
    """Set a parameter, see `NodeParameters.set_value`; return the refusal, or ""."""
    return find_refusal() or await node.set_value(name, value)


async def ask_session(board: SessionBoard, **values: object) -> str:
    """Set parameters of ``session_control``; return the refusal, or ""."""
    return find_refusal() or await await_answer(board.ask_control(**values), CONTROL)


def notify_refusal(refusal: str) -> bool:
    """Show a refusal to the person, if there is one; return whether there is."""
    if refusal:
        ui.notify(refusal, type="warning", multi_line=True)
    return bool(refusal)
