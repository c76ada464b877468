"""The page in windows of all sizes, for fingers, and for those who use no mouse."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from awaiting import until
from chromium import watched
from fake_hand import FACE, FakeHand, show_patient
from fake_nodes import FakeNodes

from us_sim.scene.listing import ListedScene
from us_sim.viewer.parameters import Parameter, ParameterKind
from us_sim.viewer.session import SessionState
from us_sim.viewer.status import NodeLevel, NodeStatus
from us_sim.viewer.stream import PageSources

PHONE = 390, 844
FOUR_TIMES = 320, 180  # what a window of 1280 × 720 holds when magnified
TABS = ("Image", "Tissue", "Cases", "Session", "Exercise", "Status")
NODE = "slice_interpolator"
PARAMETERS = (
    Parameter(NODE, "depth", ParameterKind.NUMBER, 0.04, unit="mm", size=1e-3, limits=(0.005, 0.4)),
    Parameter(NODE, "focus", ParameterKind.NUMBER, 0.0, limits=(0.0, 0.4), may_be_nothing=True),
    Parameter(NODE, "time_gain", ParameterKind.NUMBERS, (0.0,), unit="dB"),
    Parameter(NODE, "overlay", ParameterKind.TEXT, "none", choices=("none", "strain")),
    Parameter(NODE, "contact", ParameterKind.TRUTH, False),
)

Open = Callable[..., Any]


@pytest.fixture
def hand(sources: PageSources) -> FakeHand:
    """Sources that have something to show in every part of the page."""
    hand = FakeHand(sources)
    show_patient(sources)
    sources.nodes = FakeNodes()
    sources.nodes.tell(*PARAMETERS)
    sources.session.state = SessionState(True, "running", "upper_arm", "/arm.yaml")
    sources.session.scenes = (
        ListedScene("upper_arm", "/arm.yaml", description="An arm.", tracker="pose"),
        ListedScene("sweep", "case:/sweep", "case", problem="volume.file: is missing"),
    )
    now = time.monotonic()
    sources.status.add_report(NodeStatus(NODE, NodeLevel.WELL, "runs"), now)
    sources.status.add_report(
        NodeStatus("probe_tracker", NodeLevel.ERROR, "the probe is lost"), now
    )
    return hand


@pytest.fixture
def opened(browser: Any, served: Any, hand: FakeHand) -> Iterator[Open]:  # noqa: ARG001
    """Opens the page in a window of a size, with ``touch`` of a telephone, and awaits the image."""
    wrong: list[str] = []
    contexts = []

    def open_page(size: tuple[int, int], touch: bool = False) -> Any:
        width, height = size
        viewport = {"width": width, "height": height}
        contexts.append(browser.new_context(viewport=viewport, has_touch=touch, is_mobile=touch))
        page = contexts[-1].new_page()
        watched(page, served[0].addresses[0], wrong)
        page.goto(served[0].addresses[0])
        page.wait_for_function("document.querySelector('.us-image')?.width === 320")
        page.wait_for_function("document.querySelector('.us-quantity input')?.disabled === false")
        page.wait_for_selector(".us-tools-views")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not wrong


def chosen(page: Any, tab: str) -> None:
    """Choose a tab, and wait until it has slid in."""
    one = page.get_by_role("tab", name=tab)
    if one.get_attribute("aria-selected") != "true":
        before = page.query_selector(".us-panels [role=tabpanel]")
        one.click()
        page.wait_for_function("panel => !panel.isConnected", arg=before)
    page.wait_for_function(
        "!document.querySelector('.us-panels').getAnimations({ subtree: true }).length"
    )


PARTS = """() => ["#scene", "#ultrasound"].map((name) => {
    const part = document.querySelector(name);
    part.scrollIntoView();
    const { left, top, right, bottom } = part.getBoundingClientRect();
    const seen = [];
    for (let x = 0.5; x < 10; x++) for (let y = 0.5; y < 10; y++) {
        const at = [left + (x / 10) * (right - left), top + (y / 10) * (bottom - top)];
        const found = document.elementFromPoint(...at);
        if (found) seen.push(found.matches(`${name} canvas, ${name}`));
    }
    return [bottom - top, seen.filter(Boolean).length / seen.length];
})"""
"""Height of each part, CSS pixels, and how much of it, in the window, nothing lies over."""
UNREACHED = """() => [...document.querySelectorAll("header button, .us-main :is(button, input)")]
    .filter((control) => {
        if (!control.checkVisibility() || control.closest(".us-layers, .q-field")) return false;
        control.scrollIntoView({ block: "nearest", inline: "nearest" });
        const { left, top, width, height } = control.getBoundingClientRect();
        const found = document.elementFromPoint(left + width / 2, top + height / 2);
        return !control.contains(found) && !found?.contains(control);
    }).map((control) => control.ariaLabel || control.textContent)"""
"""Names of controls that no scrolling brings in front."""


@pytest.mark.parametrize(
    ("size", "touch"),
    [(PHONE, True), (FOUR_TIMES, False), ((2560, 1440), False)],
)
def test_no_part_is_buried_and_every_control_can_be_reached(
    opened: Open, size: tuple[int, int], touch: bool
) -> None:
    page = opened(size, touch)
    for height, seen in page.evaluate(PARTS):
        assert height >= 180
        assert seen > 0.75
    assert page.evaluate(UNREACHED) == []
    assert page.evaluate("document.documentElement.scrollWidth") == size[0]
    page.locator("#us-panels").click()
    for tab in TABS:
        chosen(page, tab)
        assert page.evaluate(UNREACHED) == []
    page.locator("#us-panels").click()
    page.locator("#scene").wait_for()


@pytest.mark.parametrize(("size", "touch"), [(PHONE, True), ((1280, 720), False)])
def test_axe_finds_no_violation(opened: Open, size: tuple[int, int], touch: bool) -> None:
    reason = "axe-playwright-python is not installed"
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason=reason).Axe()
    page = opened(size, touch)

    def check(what: str) -> None:
        found = axe.run(page).response["violations"]
        assert not [(what, each["id"], each["nodes"][0]["html"]) for each in found]

    check("page")
    page.get_by_role("button", name="Freeze").click()
    page.get_by_role("button", name="Layers").click()
    check("layers of a frozen image")
    page.keyboard.press("Escape")
    page.keyboard.press("?")
    page.locator(".us-help").wait_for()
    check("help")
    page.keyboard.press("Escape")
    page.locator("#us-panels").click()
    for tab in TABS:
        chosen(page, tab)
        check(tab)
    page.get_by_role("button", name="probe_tracker").click()
    page.get_by_role("dialog", name="Parameters of probe_tracker").wait_for()
    page.wait_for_function(  # faded in: until then its colours are those of both
        "[...document.querySelectorAll('.q-dialog__inner')].every(each =>"
        " !/-(enter|leave)-/.test(each.className) && !each.getAnimations({ subtree: true }).length)"
    )
    check("dialog of a node")


def fingers(page: Any) -> Callable[..., None]:
    """Real fingers: ``touch("touchStart", (x, y), (x, y))``."""
    session = page.context.new_cdp_session(page)

    def touch(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    return touch


def on_skin(page: Any) -> tuple[float, float]:
    """CSS pixels of a place on the skin beside the probe."""
    scene = "import('/us_sim/assets/scene/scene.js')"
    place = [FACE[0] + 0.04, FACE[1] + 0.04, 0.0]
    until(lambda: page.evaluate(f"{scene}.then(m => m.probePose() !== null)"), "there is a probe")
    page.wait_for_timeout(1000)  # the view turns to it
    page.locator("#scene").scroll_into_view_if_needed()
    x, y = page.evaluate(
        f"""{scene}.then(({{ stage }}) => {{
            const at = stage.project(new stage.THREE.Vector3(...{place}));
            const box = stage.canvas.getBoundingClientRect();
            return [box.left + at.x, box.top + at.y];
        }})"""
    )
    return x, y


@pytest.mark.parametrize("size", [PHONE])
def test_two_fingers_on_the_skin_press_gently_and_put_the_probe_nowhere(
    opened: Open, hand: FakeHand, size: tuple[int, int]
) -> None:
    page = opened(size, touch=True)
    x, y = on_skin(page)
    touch = fingers(page)
    touch("touchStart", (x, y))
    touch("touchStart", (x, y), (x + 20, y))
    for step in range(1, 21):
        touch("touchMove", (x, y + step), (x + 20, y + step))
    touch("touchEnd")
    hand.until(lambda: hand.total("press") == pytest.approx(2e-3, rel=0.1))
    assert all("point" not in wish["to"] for wish in hand.asked)
    hand.asked.clear()
    touch("touchStart", (x, y))
    touch("touchEnd")
    hand.until(lambda: hand.asked and "point" in hand.asked[-1]["to"])
