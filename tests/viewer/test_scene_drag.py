"""Wishes of drags in the 3D scene of a real browser to the hand, by where they are in space."""

import json
import math
from typing import Any

import numpy as np
import pytest
from fake_hand import FACE, FakeHand, show_patient

from us_sim.viewer.stream import Packet, PageSources

SCENE = "import('/us_sim/assets/scene/scene.js')"
CAMERA = f"() => {SCENE}.then(m => m.stage.camera.position.toArray())"


@pytest.fixture
def hand(page: Any, sources: PageSources) -> FakeHand:
    hand = FakeHand(sources)
    show_patient(sources)
    page.emulate_media(reduced_motion="reduce")  # the view turns at once
    page.goto(page.address)
    page.evaluate(f"async () => {{ window.scene = await {SCENE}; }}")
    page.wait_for_function("window.scene.probePose() !== null && window.scene.stage.pace.drawn > 1")
    page.wait_for_function("document.querySelector('.us-quantity input')?.disabled === false")
    await_view(page)
    return hand


def await_view(page: Any) -> None:
    """Until the view has turned to what there is to see."""
    seen: list[list[float]] = []
    while len(seen) < 2 or seen[-1] != seen[-2]:
        page.wait_for_function("window.scene.stage.pace.isAtRest")
        seen.append(page.evaluate(CAMERA))
        page.wait_for_timeout(400)
        assert len(seen) < 50


def on_screen(page: Any, point: Any) -> Any:
    """CSS pixels (2,) of a point (m) on the page."""
    return np.array(
        page.evaluate(
            f"""() => {SCENE}.then(({{ stage }}) => {{
                const at = stage.project(new stage.THREE.Vector3(...{json.dumps(list(point))}));
                const box = stage.canvas.getBoundingClientRect();
                return [box.left + at.x, box.top + at.y];
            }})"""
        )
    )


def drag(page: Any, start: Any, end: Any) -> None:
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=12)
    page.mouse.up()


def test_over_the_skin_the_probe_is_put_under_the_pointer(page: Any, hand: FakeHand) -> None:
    first, last = [0.06, 0.05, 0.0], [0.05, -0.03, 0.0]
    drag(page, on_screen(page, first), on_screen(page, last))
    hand.until(lambda: hand.asked and np.allclose(hand.asked[-1]["to"]["point"], last, atol=1.5e-3))
    np.testing.assert_allclose(hand.asked[0]["to"]["point"], first, atol=1.5e-3)
    assert all(set(wish["to"]) == {"point"} and not wish["by"] for wish in hand.asked)


def test_a_click_on_the_number_of_a_point_puts_the_probe_there(page: Any, hand: FakeHand) -> None:
    point = [0.05, -0.03, 0.01]
    step = {"what": "1: vein", "seen": "", "state": "to do", "target": [point]}
    hand.score.offer_packet(lambda n: Packet("score", n, {"scene": "", "steps": [step]}, b""))
    page.locator(".us-number").click()
    hand.until(lambda: len(hand.asked) == 1)
    np.testing.assert_allclose(hand.asked[0]["to"]["point"], [*point[:2], 0.0], atol=1e-6)


def test_the_probe_dragged_along_itself_presses_as_far(page: Any, hand: FakeHand) -> None:
    grip = np.add(FACE, [0, 0.008, -0.05])
    drag(page, on_screen(page, grip), on_screen(page, np.add(grip, [0, 0, 0.012])))
    hand.until(lambda: hand.total("press") > 0.008)
    page.wait_for_timeout(100)
    assert hand.total("press") == pytest.approx(0.012, rel=0.25)  # nearer is larger, and begun late
    assert not any("slide" in wish["by"] or wish["to"] for wish in hand.asked)


def test_the_probe_dragged_sideways_slides_with_the_pointer(page: Any, hand: FakeHand) -> None:
    grip = np.add(FACE, [0, 0.008, -0.02])
    drag(page, on_screen(page, grip), on_screen(page, np.add(grip, [0.02, 0, 0])))
    page.wait_for_timeout(150)
    across, along = hand.total("slide")
    assert across == pytest.approx(0.02, rel=0.35)
    assert abs(along) < 0.006
    assert not any("press" in wish["by"] for wish in hand.asked)


@pytest.mark.parametrize(
    ("to", "name", "sign"), [([0.02, 0, 0], "rock", -1), ([0, 0.02, 0], "fan", 1)]
)
def test_with_shift_its_grip_follows_the_pointer(
    page: Any, hand: FakeHand, to: list[float], name: str, sign: int
) -> None:
    grip = np.add(FACE, [0, 0.008, -0.09])
    page.keyboard.down("Shift")
    drag(page, on_screen(page, grip), on_screen(page, grip + to))
    page.keyboard.up("Shift")
    hand.until(lambda: abs(hand.total(name)) > 0.1)
    page.wait_for_timeout(100)
    assert hand.total(name) == pytest.approx(sign * math.atan2(0.02, 0.09), rel=0.4)


def test_beside_the_patient_or_with_alt_the_view_turns(page: Any, hand: FakeHand) -> None:
    before = page.evaluate(CAMERA)
    drag(page, (30, 400), (90, 430))
    page.wait_for_function(
        "before => window.scene.stage.camera.position.toArray()"
        ".some((x, i) => Math.abs(x - before[i]) > 0.01)",
        arg=before,
    )
    middle = page.evaluate(CAMERA)
    page.keyboard.down("Alt")
    drag(page, on_screen(page, [0.06, 0.05, 0]), on_screen(page, [0.02, 0.05, 0]))
    page.keyboard.up("Alt")
    page.wait_for_timeout(100)
    assert page.evaluate(CAMERA) != middle
    assert not hand.asked


def test_the_wheel_presses_over_the_probe_and_with_shift(page: Any, hand: FakeHand) -> None:
    page.mouse.move(*on_screen(page, np.add(FACE, [0, 0.008, -0.05])))
    page.mouse.wheel(0, 200)
    hand.until(lambda: hand.total("press") == pytest.approx(1e-3))
    page.mouse.move(*on_screen(page, [0.06, 0.05, 0]))
    page.keyboard.down("Shift")
    page.mouse.wheel(0, -200)
    page.keyboard.up("Shift")
    hand.until(lambda: hand.total("press") == pytest.approx(0.0))


def test_the_gizmo_moves_along_the_probes_own_axes(page: Any, hand: FakeHand) -> None:
    page.get_by_role("button", name="Gizmo", exact=True).click()
    tip = np.add(FACE, [0, 0, 0.018])
    drag(page, on_screen(page, tip), on_screen(page, np.add(tip, [0, 0, 0.008])))
    hand.until(lambda: hand.total("press") == pytest.approx(0.008, abs=5e-4))
    tip = np.add(FACE, [0.02, 0, 0])
    drag(page, on_screen(page, tip), on_screen(page, np.add(tip, [0.01, 0, 0])))
    hand.until(lambda: hand.total("slide") == pytest.approx([0.01, 0.0], abs=5e-4))


def test_where_somebody_else_leads_the_view_turns_instead(page: Any, hand: FakeHand) -> None:
    hand.say(leader="path_player", obstacle="path_player moves the probe")
    page.wait_for_function("document.querySelector('.us-quantity input').disabled")
    drag(page, on_screen(page, [0.06, 0.05, 0]), on_screen(page, [0.02, 0.05, 0]))
    page.wait_for_timeout(100)
    assert not hand.asked
