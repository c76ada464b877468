"""The bar above the image: what it sets, what it watches, and what it does when it is refused."""

import time
from typing import Any

import cv2
import numpy as np
import pytest
from awaiting import until
from fake_nodes import FakeNodes

from us_sim.viewer.parameters import Parameter, ParameterKind
from us_sim.viewer.status import NodeLevel, NodeStatus
from us_sim.viewer.stream import Feed, Packet, PageSources

NODE = "slice_interpolator"
PIXEL = "() => {{ const c = document.querySelector('{}'); return c ? Array.from("
PIXEL += "c.getContext('2d').getImageData(5, 5, 1, 1).data).slice(0, 3) : null; }}"


def known(value: str, is_flipped: bool = False) -> list[Parameter]:
    overlay = Parameter(
        NODE, "overlay", ParameterKind.TEXT, value, choices=("none", "strain", "velocity")
    )
    switches = {"flip": is_flipped, "beside": False}
    return [
        overlay,
        *(Parameter(NODE, name, ParameterKind.TRUTH, on) for name, on in switches.items()),
    ]


@pytest.fixture
def asked(sources: PageSources) -> list[str]:
    """The modes that the node was asked to show; it refuses velocity."""
    values: list[str] = []

    def take(_: Parameter, raw: Any) -> str:
        values.append(raw)
        if raw == "velocity":
            return "overlay: this scene has nothing for 'velocity'"
        sources.nodes.tell(*known(raw))
        return ""

    sources.nodes = FakeNodes(take)
    sources.nodes.tell(*known("none"))
    return values


def coloured(sources: PageSources, kind: str, bgr: tuple[int, int, int]) -> Feed:
    """A stream with one picture of that colour."""
    feed = Feed(kind)
    picture = np.full((32, 32, 3), bgr, np.uint8)
    jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
    header = {"stamp": "1", "rows": 32, "columns": 32, "encoding": "jpeg"}
    feed.offer_packet(lambda sequence: Packet(kind, sequence, header, jpeg))
    sources.add_feeds(feed)
    return feed


def test_a_mode_is_asked_for_shown_and_left(
    page: Any, sources: PageSources, asked: list[str]
) -> None:
    plain = Feed("image")
    pixels = np.full((32, 32), 90, np.uint8).tobytes()
    header = {"stamp": "1", "rows": 32, "columns": 32, "encoding": "mono8"}
    plain.offer_packet(lambda sequence: Packet("image", sequence, header, pixels))
    sources.add_feeds(plain)
    annotated = coloured(sources, "annotated", (0, 0, 200))
    page.goto(page.address)
    image = PIXEL.format(".us-image")
    page.wait_for_function(f"({image})()?.[0] === 90")
    assert not annotated.is_watched
    page.get_by_role("button", name="Strain", exact=True).click()
    page.wait_for_function(f"({image})()?.[1] === 0")
    assert asked == ["strain"]
    until(lambda: not plain.is_watched, "nobody watches the plain image any more")
    pressed = page.get_by_role("button", pressed=True)
    assert pressed.all_text_contents() == ["Strain"]
    page.get_by_role("button", name="B-mode").click()
    page.wait_for_function(f"({image})()?.[0] === 90")
    assert asked == ["strain"]  # nothing is asked of the node for the plain image
    until(lambda: not annotated.is_watched, "nobody watches what was drawn over it any more")


@pytest.mark.usefixtures("asked")
def test_a_refused_mode_says_why_and_stays_as_it_was(page: Any, sources: PageSources) -> None:
    annotated = coloured(sources, "annotated", (0, 0, 200))
    page.goto(page.address)
    page.get_by_role("button", name="Colour").click()
    page.get_by_text("this scene has nothing for 'velocity'").wait_for()
    assert page.get_by_role("button", pressed=True).all_text_contents() == ["B-mode"]
    until(lambda: not annotated.is_watched, "what was refused is not watched")


@pytest.mark.usefixtures("asked")
def test_why_an_image_shows_little_is_said_on_it(page: Any, sources: PageSources) -> None:
    def see(**values: str) -> None:
        sources.status.add_report(
            NodeStatus(NODE, NodeLevel.WELL, "imaging", values), time.monotonic()
        )

    def is_said(*words: str) -> None:
        page.wait_for_function(
            "words => { const said = document.querySelector('.us-stale');"
            " const lines = said.hidden ? [] : said.textContent.split('\\n');"
            " return lines.length === words.length"
            " && words.every((word, i) => lines[i].includes(word)); }",
            arg=list(words),
        )

    page.goto(page.address)
    see(contact="none", no_colour="no_contact")
    is_said("No contact")
    see(contact="good", no_colour="across_flow")
    is_said()
    page.get_by_role("button", name="Outlines").click()
    page.get_by_role("button", name="Outlines", pressed=True).wait_for()
    sources.nodes.tell(*known("velocity"))
    is_said("No colour: the beams cross")
    see(contact="poor", no_colour="no_contact", no_spectrum="no_vessel")
    is_said("Poor contact")
    page.get_by_role("button", name="Spectrum").click()
    is_said("Poor contact", "No spectrum: no vessel")
    see(contact="good", no_colour="", no_spectrum="")
    is_said()
    tissue = NodeStatus("tissue_deformer", NodeLevel.WELL, "fem", {"force": "24.20"})
    sources.status.add_report(tissue, time.monotonic())
    is_said("Too much force: 24 N")
    words = "3 tetrahedra are inside out: msds is not made for this (set solver)"
    tissue = NodeStatus("tissue_deformer", NodeLevel.WARNING, words, {"problem": "inside out"})
    sources.status.add_report(tissue, time.monotonic())
    is_said("Tissue is inside out")
    tissue = NodeStatus("tissue_deformer", NodeLevel.WELL, "fem", {"unbalanced": "1"})
    sources.status.add_report(tissue, time.monotonic())
    is_said()


@pytest.mark.parametrize(("name", "kind"), [("M-mode", "m_mode"), ("Spectrum", "spectrum")])
def test_a_strip_is_watched_while_it_is_shown(
    page: Any, sources: PageSources, name: str, kind: str
) -> None:
    feed = coloured(sources, kind, (200, 0, 0))
    page.goto(page.address)
    button = page.get_by_role("button", name=name)
    button.click()
    page.wait_for_function(f"({PIXEL.format('.us-strip')})()?.[2] > 190")
    assert feed.is_watched
    button.click()
    page.wait_for_function("!document.querySelector('.us-strip')")
    until(lambda: not feed.is_watched, "nobody watches the strip any more")


def test_flip_is_asked_for_and_followed_where_it_was_set_elsewhere(
    page: Any, sources: PageSources, asked: list[Any]
) -> None:
    page.goto(page.address)
    flip = page.get_by_role("button", name="Flip")
    flip.click()
    until(lambda: asked == [True], "the node is asked")
    sources.nodes.tell(*known("none", is_flipped=True))
    until(lambda: flip.get_attribute("aria-pressed") == "true", "it is flipped")
    flip.click()
    until(lambda: asked == [True, False], "the node is asked for the other")


def test_beside_is_asked_for_with_outlines_where_nothing_is_over_the_image(
    page: Any, asked: list[Any]
) -> None:
    page.goto(page.address)
    page.get_by_role("button", name="Beside").click()
    until(lambda: asked == [True, "none"], "the node is asked for both")
    page.locator("button[aria-pressed=true]", has_text="Outlines").wait_for()
