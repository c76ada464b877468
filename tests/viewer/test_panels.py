"""The panels in a real browser: controls made of parameters, set, refused, moved by others."""

import re
import time
from typing import Any

import pytest
from awaiting import until
from fake_nodes import FakeNodes

from us_sim.viewer.parameters import Parameter, ParameterKind
from us_sim.viewer.status import NodeLevel, NodeStatus
from us_sim.viewer.stream import ONLY_WATCHES, PageSources

NODE = "slice_interpolator"


def made(
    name: str, kind: ParameterKind = ParameterKind.NUMBER, raw: Any = 0.0, **fields: Any
) -> Parameter:
    return Parameter(NODE, name, kind, raw, description=f"the {name}", **fields)


PARAMETERS = (
    made("depth", raw=0.04, unit="mm", size=1e-3, limits=(0.005, 0.4)),
    made("gain", unit="dB", limits=(-60.0, 60.0)),
    made("focus", unit="mm", size=1e-3, limits=(0.0, 0.4), may_be_nothing=True),
    made("time_gain", ParameterKind.NUMBERS, (0.0,), unit="dB"),
    made("overlay", ParameterKind.TEXT, "none", choices=("none", "strain")),
    made("contact", ParameterKind.TRUTH, False),
    made("colour.pulses", ParameterKind.WHOLE, 10, limits=(3, 64)),
    made("flow.direction", ParameterKind.NUMBERS, (0.0, 1.0, 0.0)),
    made("frame", ParameterKind.TEXT, "arm", is_live=False),
    made("scene", ParameterKind.TEXT, "exercise:e#7", is_live=False),
)


class Node:
    """In place of a node: takes what it is sent, or refuses it, and tells the page."""

    def __init__(self, sources: PageSources) -> None:
        self.sent: list[tuple[float, str, Any]] = []
        self.refusal = ""
        self.parameters = {parameter.name: parameter for parameter in PARAMETERS}
        self.nodes = sources.nodes = FakeNodes(self._take)
        self.tell()

    def tell(self, *parameters: Parameter) -> None:
        self.parameters |= {parameter.name: parameter for parameter in parameters}
        self.nodes.tell(*self.parameters.values())

    def values(self, name: str) -> list[Any]:
        return [raw for _, which, raw in self.sent if which == name]

    def _take(self, parameter: Parameter, raw: Any) -> str:
        self.sent.append((time.monotonic(), parameter.name, raw))
        if not self.refusal:
            self.tell(self.parameters[parameter.name].with_raw(raw))
        return self.refusal


@pytest.fixture
def node(sources: PageSources) -> Node:
    return Node(sources)


def opened(page: Any, tab: str) -> None:
    page.goto(page.address)
    page.get_by_role("button", name="Panels").click()
    page.get_by_role("tab", name=tab).click()


def control(page: Any, name: str) -> Any:
    return page.locator(f'[data-parameter="{NODE}.{name}"]')


def field(page: Any, name: str) -> Any:
    return control(page, name).locator("input")


def shows(page: Any, name: str, text: str) -> None:
    until(lambda: field(page, name).input_value() == text, f"{name} shows {text}")


def test_who_only_watches_sets_nothing(page: Any, node: Node) -> None:
    page.goto(f"{page.address}?watch")
    page.get_by_role("button", name="Panels").click()
    page.get_by_role("tab", name="Image").click()
    shows(page, "depth", "40")
    assert field(page, "depth").is_disabled()
    assert control(page, "depth").get_attribute("title") == ONLY_WATCHES
    assert control(page, "contact").locator("[role=switch]").get_attribute("aria-disabled")
    assert page.locator(".us-level").is_disabled()
    assert page.get_by_role("button", name="Strain", exact=True).is_disabled()
    page.get_by_role("button", name="Outlines").click()  # as it is set already
    page.locator("[aria-pressed=true]", has_text="Outlines").wait_for()
    number = int(control(page, "depth").get_attribute("id").removeprefix("c"))
    page.evaluate("number => getElement(number).set(50)", number)
    page.get_by_text(ONLY_WATCHES).wait_for()
    assert node.sent == []


def test_the_options_of_a_choice_are_a_group_in_a_part_of_the_page(page: Any, node: Node) -> None:
    opened(page, "Image")
    control(page, "overlay").locator(".q-select").click()
    choices = page.get_by_role("region", name="Choices")
    choices.get_by_role("listbox").get_by_role("group").get_by_role("option", name="strain").click()
    until(lambda: node.values("overlay") == ["strain"], "it is set")


def test_a_number_is_set_in_its_unit(page: Any, node: Node) -> None:
    opened(page, "Image")
    shows(page, "depth", "40")
    assert "mm" in control(page, "depth").inner_text()
    field(page, "depth").fill("55")
    field(page, "depth").press("Enter")
    until(lambda: node.values("depth") == [0.055], "the depth is sent in metres")
    field(page, "focus").fill("20,5")
    field(page, "focus").blur()
    until(lambda: node.values("focus") == [0.0205], "the focus is sent")
    field(page, "focus").fill("")
    field(page, "focus").press("Enter")
    until(lambda: node.values("focus") == [0.0205, 0.0], "0 stands for none")
    assert field(page, "focus").get_attribute("placeholder") == "none"


def test_a_slider_sends_ten_times_a_second_at_most_and_its_last_for_certain(
    page: Any, node: Node
) -> None:
    opened(page, "Image")
    shows(page, "gain", "0")
    box = control(page, "gain").locator(".q-slider__track").bounding_box()
    height = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + box["width"] / 2, height)
    page.mouse.down()
    begun = time.monotonic()
    for i in range(1, 61):
        page.mouse.move(box["x"] + box["width"] * (0.5 + i / 240), height)
    node.tell(node.parameters["gain"].with_raw(-40.0))  # from elsewhere: the hand is stronger
    page.mouse.move(box["x"] + box["width"] + 50, height)
    page.mouse.up()
    lasted = time.monotonic() - begun
    until(lambda: node.values("gain")[-1:] == [60.0], "the end of the slider is sent")
    shows(page, "gain", "60")
    assert len(node.sent) <= lasted / 0.1 + 3
    assert all(-60.0 <= raw <= 60.0 for raw in node.values("gain"))


def test_every_kind_has_its_control_and_the_keyboard_will_do(page: Any, node: Node) -> None:
    opened(page, "Image")
    shows(page, "gain", "0")
    field(page, "gain").focus()
    field(page, "gain").press("ArrowUp")
    until(lambda: node.values("gain") == [0.2], "a step up")
    page.keyboard.press("Tab")
    page.keyboard.press("Shift+Tab")
    page.keyboard.press("Shift+Tab")  # the slider before the field
    page.keyboard.press("ArrowRight")
    until(lambda: node.values("gain")[-1] == pytest.approx(0.4), "a step of the slider")
    contact = control(page, "contact").get_by_role("switch")
    contact.focus()
    page.keyboard.press("Space")
    until(lambda: node.values("contact") == [True], "the switch is on")
    field(page, "overlay").focus()
    page.keyboard.press("Enter")
    page.get_by_role("option", name="strain").wait_for()
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    until(lambda: node.values("overlay") != [], "a choice is sent")
    page.get_by_role("button", name='Expand "Colour"').focus()
    page.keyboard.press("Enter")
    field(page, "colour.pulses").fill("12")
    field(page, "colour.pulses").press("Enter")
    until(lambda: node.values("colour.pulses") == [12], "a whole number")
    page.get_by_text("Flow", exact=True).click()
    field(page, "flow.direction").fill("1, 0,0")
    field(page, "flow.direction").press("Enter")
    until(lambda: node.values("flow.direction") == [(1.0, 0.0, 0.0)], "a list")
    page.get_by_text("Given at the start", exact=True).click()
    until(lambda: "arm" in control(page, "frame").inner_text(), "what cannot be set is shown")
    assert control(page, "frame").locator("input").count() == 0
    assert not page.get_by_text("#7").count()  # which would name an examination's arm


def test_nothing_is_watched_that_cannot_be_seen(page: Any, node: Node) -> None:
    page.goto(page.address)
    page.get_by_role("button", name="Panels").wait_for()
    page.get_by_role("button", name="Panels").click()
    tissue = {"tissue_deformer", "skin_deformer", "probe_tracker"}
    page.get_by_role("tab", name="Tissue").click()
    until(lambda: node.nodes.watched >= tissue, "the tissue panel is seen")
    until(
        lambda: "tissue_deformer is not running" in page.locator(".us-panels").inner_text(),
        "absent nodes are said",
    )
    page.get_by_role("button", name="Panels").click()
    until(lambda: not node.nodes.watched & tissue, "the drawer is closed")
    page.get_by_role("button", name="Panels").click()
    until(lambda: node.nodes.watched >= tissue, "and open again")
    page.get_by_role("tab", name="Image").click()
    until(lambda: not node.nodes.watched & tissue, "another tab is chosen")
    page.get_by_role("tab", name="Tissue").click()
    until(lambda: node.nodes.watched >= tissue, "and this one again")
    page.goto("about:blank")
    until(lambda: node.nodes.watched == set(), "the page has gone")


def test_status(page: Any, sources: PageSources, node: Node) -> None:
    board = sources.status
    values = {"state": "fem", "rate_hz": "59.9", "latency_p50_ms": "7.04", "latency_p99_ms": "120"}
    values |= {"received": "300", "dropped": "3", "residual": "1e-3"}
    opened(page, "Status")
    until(lambda: board.is_watched, "the status is seen")

    def tell() -> None:
        now = time.monotonic()
        board.add_report(NodeStatus("tissue_deformer", NodeLevel.WELL, "fem", values), now)
        board.add_report(NodeStatus("probe_tracker", NodeLevel.ERROR, "the probe is lost", {}), now)

    def rows() -> list[str]:
        tell()
        return [
            re.sub(r"\s+", " ", text) for text in page.locator(".us-status tbody").all_inner_texts()
        ]

    until(lambda: len(rows()) == 2, "two nodes are told")
    assert rows()[1].strip() == "tissue_deformer fem 59.9 7.0 · 120 300 3"
    assert "the probe is lost" in rows()[0]
    page.get_by_role("button", name="tissue_deformer").click()
    page.get_by_role("dialog").wait_for()
    until(lambda: "tissue_deformer" in node.nodes.watched, "the dialog shows its parameters")
    page.keyboard.press("Escape")
    until(lambda: "tissue_deformer" not in node.nodes.watched, "the dialog is closed")
    page.goto("about:blank")
    until(lambda: not board.is_watched, "nobody looks any more")
