"""Wishes of keys, drags, wheel, fingers and sliders of a real browser to the hand."""

import math
from typing import Any

import pytest
from fake_hand import MATRIX, PIXEL, STANCE, FakeHand

from us_sim.viewer.stream import PageSources


@pytest.fixture
def viewer(page: Any, sources: PageSources) -> FakeHand:
    viewer = FakeHand(sources)
    page.goto(page.address)
    page.wait_for_function("document.querySelector('.us-image')?.width === 320")
    page.wait_for_function("document.querySelector('.us-quantity input')?.disabled === false")
    return viewer


def box_of_image(page: Any) -> Any:
    return page.evaluate("document.querySelector('.us-image').getBoundingClientRect().toJSON()")


@pytest.mark.parametrize(
    ("key", "quantity", "sign"),
    [
        ("s", "press", 1),
        ("q", "rotation", -1),
        ("Shift+ArrowUp", "fan", 1),
        ("Shift+ArrowLeft", "rock", -1),
    ],
)
def test_a_key_makes_a_small_step(
    page: Any, viewer: FakeHand, key: str, quantity: str, sign: int
) -> None:
    page.keyboard.press(key)
    viewer.until(lambda: viewer.asked)
    step = viewer.total(quantity)
    assert step * sign == pytest.approx(3e-4 if quantity == "press" else math.radians(1))


def test_arrows_slide_and_go_on_while_they_are_held(page: Any, viewer: FakeHand) -> None:
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    viewer.until(lambda: viewer.total("slide") == pytest.approx([7.5e-4, -7.5e-4]))
    viewer.asked.clear()
    page.keyboard.down("ArrowLeft")
    viewer.until(lambda: viewer.asked and viewer.total("slide")[0] < -5e-3)
    page.keyboard.up("ArrowLeft")
    page.wait_for_timeout(100)
    count = len(viewer.asked)
    page.wait_for_timeout(150)
    assert len(viewer.asked) == count


@pytest.mark.parametrize("pause", [0, 300])  # ms that the page takes for a picture
def test_a_held_key_moves_the_probe_by_the_time_that_it_was_held(
    page: Any, viewer: FakeHand, pause: int
) -> None:
    page.evaluate(
        """(pause) => {
            window.times = [];
            for (const name of ["keydown", "keyup"]) {
                addEventListener(name, (event) => event.repeat || times.push(event.timeStamp));
            }
            const next = window.requestAnimationFrame;
            if (pause) window.requestAnimationFrame = (turn) => setTimeout(() => next(turn), pause);
        }""",
        pause,
    )
    page.keyboard.down("ArrowLeft")
    page.wait_for_timeout(1200)
    page.keyboard.up("ArrowLeft")
    down, up = page.evaluate("times")
    way = -7.5e-4 - 0.03 * ((up - down) / 1000 - 0.22)
    viewer.until(lambda: viewer.total("slide") == pytest.approx([way, 0], rel=0.02))


def test_most_of_the_press_slider_presses_and_it_goes_by_keys(page: Any, viewer: FakeHand) -> None:
    press = page.locator(".us-quantity input[type=range]").first
    slide = """(slider, part) => {
        slider.value = +slider.min + part * (slider.max - slider.min);
        slider.dispatchEvent(new Event("input"));
    }"""
    contact = float(press.evaluate("s => s.parentNode.style.getPropertyValue('--contact')"))
    middle = (1 + contact) / 2
    for part, metres in ((0, -0.05), (contact, 0), (middle, 0.0125), (1, 0.025)):
        press.evaluate(slide, part)
        viewer.until(lambda: viewer.asked)
        there = pytest.approx(metres, abs=1e-4)
        viewer.until(lambda there=there: viewer.asked[-1]["to"]["press"] == there)
    viewer.say(goal={**STANCE, "press": -0.01})
    page.wait_for_function("document.querySelector('.us-quantity input').ariaValueText[0] === '-'")
    press.focus()
    for key, metres in (("ArrowRight", -9.5e-3), ("ArrowLeft", -10e-3)):
        page.keyboard.press(key)
        there = pytest.approx(metres, abs=1e-4)
        viewer.until(lambda there=there: viewer.asked[-1]["to"].get("press") == there)
    viewer.asked.clear()
    for key, sign in (("PageDown", 1), ("PageUp", -1), ("s", 1)):
        page.keyboard.press(key)
        viewer.until(lambda: viewer.asked)
        assert viewer.asked.pop()["by"] == {"press": pytest.approx(sign * 3e-4)}


def test_keys_are_not_taken_from_who_types(page: Any, viewer: FakeHand) -> None:
    number = page.locator(".us-quantity input[type=number]").first
    number.click()
    page.keyboard.press("ArrowUp")
    page.keyboard.press("s")
    page.wait_for_timeout(100)
    assert not any("by" in wish and wish["by"] for wish in viewer.asked)
    number.fill("7.5")
    page.keyboard.press("Enter")
    viewer.until(lambda: viewer.asked[-1:] and viewer.asked[-1]["to"] == {"press": 0.0075})


@pytest.mark.parametrize(
    ("row", "typed", "there", "asked", "said"),
    [
        (1, "999", "60", {"fan": math.radians(60)}, "Fan: -60 to 60°"),
    ],
)
def test_a_number_beyond_its_range_is_put_to_the_nearest_end_and_that_is_said(
    page: Any, viewer: FakeHand, row: int, typed: str, there: str, asked: Any, said: str
) -> None:
    number = page.locator(".us-quantity input[type=number]").nth(row)
    line = page.locator(".us-said")
    number.fill(typed)
    page.keyboard.press("Enter")
    assert number.input_value() == there
    viewer.until(lambda: viewer.asked[-1:])
    assert viewer.asked[-1]["to"] == pytest.approx(asked, abs=4e-4)
    assert line.inner_text() == said
    assert "us-wrong" in line.get_attribute("class")
    number.fill("20")
    page.keyboard.press("Enter")
    viewer.until(lambda: viewer.asked[-1]["to"] != pytest.approx(asked, abs=4e-4))
    assert "us-wrong" not in line.get_attribute("class")


def test_the_space_bar_is_the_pages_after_a_click_and_a_buttons_after_tab(
    page: Any, viewer: FakeHand
) -> None:
    freezing = page.get_by_role("button", name="Freeze")
    going_on = page.get_by_role("button", name="Go on")
    gizmo = page.get_by_role("button", name="Gizmo")
    page.get_by_role("button", name="Centre", exact=True).click()
    viewer.until(lambda: viewer.asked[-1:] and viewer.asked[-1].get("go") == "home")
    page.keyboard.press("Space")
    going_on.wait_for()
    page.get_by_role("button", name="Panels").click()
    page.get_by_role("tab").first.click()
    page.keyboard.press("Space")
    freezing.wait_for()
    page.get_by_role("button", name="?", exact=True).click()
    page.keyboard.press("Escape")
    page.wait_for_selector(".us-help", state="hidden")
    page.keyboard.press("Space")
    going_on.wait_for()
    assert not page.locator(".us-help[open]").count()
    assert [wish.get("go") for wish in viewer.asked] == ["home"]
    gizmo.focus()
    for is_on in ("true", "false"):  # and it keeps the focus
        page.keyboard.press("Space")
        page.wait_for_selector(f"button[aria-pressed={is_on}]:text('Gizmo')")
    assert going_on.is_visible()


def test_dragging_down_the_image_presses_as_many_millimetres(page: Any, viewer: FakeHand) -> None:
    box = box_of_image(page)
    metres = 320 * PIXEL / box["height"]
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.2 * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 3, y + 100, steps=20)
    page.mouse.up()
    viewer.until(lambda: viewer.total("press") == pytest.approx(100 * metres, rel=0.06))
    assert not any("slide" in wish["by"] for wish in viewer.asked)
    assert [wish["sequence"] for wish in viewer.asked] == sorted(
        {wish["sequence"] for wish in viewer.asked}
    )


@pytest.mark.parametrize("flip", [1, -1])
def test_dragging_sideways_slides_and_the_wheel_presses(
    page: Any, viewer: FakeHand, flip: int
) -> None:
    viewer.show(stamp="2", matrix=[flip * PIXEL, 0, 0, flip * -0.0128, *MATRIX[4:]])
    shown = "import('/us_sim/assets/image.js').then(m => m.frameShown().header.stamp)"
    viewer.until(lambda: page.evaluate(shown) == "2")
    box = box_of_image(page)
    metres = 320 * PIXEL / box["height"]
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 60, y, steps=10)
    page.mouse.up()
    viewer.until(lambda: viewer.total("slide")[0] == pytest.approx(flip * -60 * metres, rel=0.1))
    viewer.asked.clear()
    page.mouse.wheel(0, 300)
    viewer.until(lambda: viewer.total("press") == pytest.approx(1.5e-3))


def test_over_a_frozen_image_the_probe_stays_and_that_is_said(page: Any, viewer: FakeHand) -> None:
    box = box_of_image(page)
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
    page.keyboard.press("Space")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, y + 60, steps=4)
    page.mouse.up()
    page.mouse.wheel(0, 300)
    assert "is frozen" in page.locator(".us-stale").inner_text()
    page.keyboard.press("q")  # what the page sends comes in order
    viewer.until(lambda: viewer.asked)
    assert [[*wish["by"]] for wish in viewer.asked] == [["rotation"]]


def test_two_fingers_press_and_rotate(page: Any, viewer: FakeHand) -> None:
    page.evaluate(
        """() => {
            const place = document.querySelector("#ultrasound");
            const tell = (type, pointerId, x, y) => place.dispatchEvent(new PointerEvent(type,
                {pointerId, clientX: x, clientY: y, button: 0, bubbles: true,
                 pointerType: "touch"}));
            place.setPointerCapture = () => {};
            place.hasPointerCapture = () => true;
            tell("pointerdown", 1, 800, 300);
            tell("pointerdown", 2, 900, 300);
            for (let i = 1; i <= 50; i++) {
                tell("pointermove", 1, 800, 300 + i / 2);
                tell("pointermove", 2, 900, 300 + i);
            }
            tell("pointerup", 1, 800, 325);
            tell("pointerup", 2, 900, 350);
        }"""
    )
    metres = 320 * PIXEL / box_of_image(page)["height"]
    viewer.until(lambda: viewer.total("rotation") == pytest.approx(math.atan2(25, 100), abs=1e-6))
    assert viewer.total("press") == pytest.approx(37.5 * metres, rel=1e-6)


def test_sliders_show_how_the_probe_is_held_and_move_it(page: Any, viewer: FakeHand) -> None:
    values = page.locator(".us-quantity input[type=number]").evaluate_all(
        "entries => entries.map(entry => entry.value)"
    )
    assert values == ["4.2", "-11", "0", "0", "12.0", "0.0"]
    fan = page.locator(".us-quantity input[type=range]").nth(1)
    fan.evaluate("s => { s.value = 20; s.dispatchEvent(new Event('input')); }")
    viewer.until(lambda: viewer.asked)
    assert viewer.asked[-1]["to"]["fan"] == pytest.approx(math.radians(20))
    page.get_by_role("button", name="Centre", exact=True).click()
    viewer.until(lambda: viewer.asked[-1].get("go") == "home")


def test_who_else_leads_is_said_and_what_is_refused(page: Any, viewer: FakeHand) -> None:
    said = page.locator(".us-said")
    page.keyboard.press("l")
    page.wait_for_function("document.querySelector('.us-said').textContent === 'the hand cannot'")
    viewer.say(leader="path_player", obstacle="path_player moves the probe")
    page.wait_for_function("document.querySelector('.us-quantity input').disabled")
    page.wait_for_function(
        "document.querySelector('.us-said').textContent.startsWith('path_player')", timeout=8000
    )
    assert "us-wrong" not in (said.get_attribute("class") or "")


def test_the_delay_counts_from_the_key_to_the_painted_image(page: Any, viewer: FakeHand) -> None:
    assert page.evaluate("usSim.latency()") == {"count": 0}
    page.keyboard.press("s")
    viewer.until(lambda: viewer.asked)
    wish = viewer.asked[-1]
    viewer.show(command=["another", 99])
    page.wait_for_timeout(200)
    assert page.evaluate("usSim.latency()") == {"count": 0}
    viewer.show(command=[wish["source"], wish["sequence"]])
    page.wait_for_function("usSim.latency().count > 0")
    assert page.evaluate("usSim.latency().count") == wish["sequence"]
    assert 200 < page.evaluate("usSim.latency().median") < 2000
    page.evaluate("usSim.resetLatency()")
    assert page.evaluate("usSim.latency()") == {"count": 0}


def test_what_is_replayed_is_ended_by_one_button_that_is_there_only_then(
    page: Any, viewer: FakeHand
) -> None:
    button = page.get_by_role("button", name="Take the probe")
    centre = page.get_by_role("button", name="Centre")
    assert not button.is_visible()
    assert centre.is_enabled()
    viewer.say(leader="path_player", obstacle="the replay of a.mcap moves the probe", can_take=True)
    button.wait_for()
    assert not centre.is_enabled()
    button.click()
    viewer.until(lambda: len(viewer.takes) == 1)
    viewer.say(holder=viewer.takes[0])
    button.wait_for(state="hidden")
    assert centre.is_enabled()
    assert page.locator(".us-said").inner_text() == "You hold the probe"


def test_a_page_whose_connection_was_lost_holds_the_probe_again_unless_another_took_it(
    page: Any, viewer: FakeHand
) -> None:
    said = "text => document.querySelector('.us-said').textContent.includes(text)"
    page.keyboard.press("s")
    viewer.until(lambda: viewer.asked)
    source = viewer.asked[-1]["source"]
    viewer.say(holder=source)
    page.wait_for_function(said, arg="You hold the probe")
    lost = "() => import('/us_sim/assets/stream.js').then(m => m.stream.reconnect())"
    viewer.asked.clear()
    viewer.say(holder="")  # its connection has ended
    viewer.until(lambda: len(viewer.asked) == 1)
    page.reload()
    viewer.until(lambda: len(viewer.asked) == 2)  # loaded anew it is the same
    assert {wish["source"] for wish in viewer.asked} == {source}
    assert not any(wish["to"] or wish["by"] for wish in viewer.asked)
    page.evaluate(lost)
    page.wait_for_function(said, arg="The viewer does not answer")
    viewer.say(holder="another")
    page.wait_for_function(said, arg="Another page has taken the probe")
    viewer.say(holder="")
    page.wait_for_function(said, arg="Nobody holds the probe")
    assert len(viewer.asked) == 2


def test_a_page_that_does_not_hold_the_probe_has_one_button_that_takes_it_over(
    page: Any, viewer: FakeHand
) -> None:
    button = page.get_by_role("button", name="Take over")
    assert not button.is_visible()
    viewer.say(holder="another")
    button.wait_for()
    slider = page.locator(".us-quantity input").first
    assert slider.is_disabled()
    assert page.locator(".us-said").inner_text() == "Another page holds the probe"
    button.click()
    viewer.until(lambda: len(viewer.takes) == 1)
    viewer.say(holder=viewer.takes[0])
    button.wait_for(state="hidden")
    assert slider.is_enabled()


def test_a_page_that_only_watches_never_moves_the_probe(page: Any, viewer: FakeHand) -> None:
    page.goto(f"{page.address}?watch")
    page.wait_for_selector(".us-quantity input:disabled")
    page.keyboard.press("s")
    box = box_of_image(page)
    page.mouse.move(box["x"] + 9, box["y"] + 9)
    page.mouse.wheel(0, 100)
    viewer.say(holder="another")
    page.get_by_text("This page only watches").wait_for()
    assert not page.get_by_role("button", name="Take over").is_visible()
    viewer.say(leader="path_player", obstacle="a.mcap moves the probe", can_take=True)
    page.get_by_text("a.mcap moves the probe").wait_for()
    assert not page.get_by_role("button", name="Take the probe").is_visible()
    assert viewer.asked == []


def test_a_viewer_that_says_nothing_any_more_does_not_answer(page: Any, viewer: FakeHand) -> None:
    said = "text => document.querySelector('.us-said').textContent.includes(text)"
    viewer.say(every=0.2)
    page.wait_for_function(said, arg="Nobody holds the probe")
    page.wait_for_function(said, arg="The viewer does not answer")
    assert not page.get_by_role("button", name="Centre").is_enabled()
    assert "us-wrong" in page.locator(".us-said").get_attribute("class")
    viewer.say(every=0.2)
    page.wait_for_function(said, arg="Nobody holds the probe")
