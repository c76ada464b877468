"""`us-sim view` used by a person in a real browser: the arm is pressed, and let go.

Each step leaves a picture of the page in the folder that US_SIM_SCREENSHOTS names, or in the test's
own.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from awaiting import until
from chromium import watched
from served_view import START_S, served_view

STEP = 4
"""Of the image's pixels each so many-th of each so many-th row is looked at."""
PIXELS = """step => {
    const canvas = document.querySelector(".us-image");
    const { width, height } = canvas;
    const data = canvas.getContext("2d").getImageData(0, 0, width, height).data;
    const values = [];
    for (let y = 0; y < height; y += step)
        for (let x = 0; x < width; x += step) values.push(data[4 * (y * width + x)]);
    return [Math.ceil(width / step), Math.ceil(height / step), values];
}"""
DARK = 25
"""Grey value below which blood is in the middle of a vessel."""


class Person:
    """Somebody at the page."""

    def __init__(self, page: Any, pictures: Path) -> None:
        self.page, self._pictures = page, pictures

    def picture(self, name: str) -> None:
        self.page.screenshot(path=self._pictures / f"viewer_{name}.png")

    def image(self) -> Any:
        """(rows, columns) grey values of the ultrasound image, thinned out."""
        columns, rows, values = self.page.evaluate(PIXELS, STEP)
        return np.reshape(values, (rows, columns)).astype(float)

    def vein(self) -> int:
        """Dark pixels where the vein is, and below the skin, beside the bone."""
        image = self.image()
        rows, columns = image.shape
        part = image[rows // 10 : int(0.42 * rows), int(0.44 * columns) : int(0.66 * columns)]
        return int((part < DARK).sum())

    def go_home(self) -> None:
        """Let go, and have the probe where it began."""
        self.page.get_by_role("button", name="Upright").click()
        self.press(1.0)

    def press(self, millimetres: float) -> None:
        """Type how far the probe is pressed in, and wait until the tissue has followed."""
        field = self.page.get_by_role("spinbutton", name="Press")
        field.fill(f"{millimetres}")
        field.press("Enter")
        field.blur()
        self.settle()

    def settle(self) -> None:
        """Until the image does not change any more."""
        last = self.image()

        def is_still() -> bool:
            nonlocal last
            time.sleep(0.4)
            now, before = self.image(), last
            last = now
            return now.shape == before.shape and bool(np.abs(now - before).mean() < 1.0)

        until(is_still, "the image comes to rest")

    def drag_down(self, pixels: float) -> None:
        """Drag the probe down with the mouse, over the image."""
        box = self.page.locator(".us-image").bounding_box()
        x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.25 * box["height"]
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        for i in range(30):
            self.page.mouse.move(x, y + pixels * (i + 1) / 30)
            self.page.wait_for_timeout(20)
        self.page.mouse.up()
        self.settle()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("view")


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    """Where `us-sim view` of the arm serves its page."""
    with served_view(folder, "upper_arm") as served:
        yield served.address


@pytest.fixture(scope="module")
def person(browser: Any, address: str, folder: Path) -> Iterator[Person]:
    """At a page of 1280 × 720, of which nothing may go wrong until the last test."""
    pictures = Path(os.environ.get("US_SIM_SCREENSHOTS") or folder)
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    wrong: list[str] = []
    watched(page, address, wrong)
    page.goto(address)
    page.wait_for_function("window.usSim?.images?.() > 3", timeout=1e3 * START_S)
    page.get_by_text("starting").wait_for(state="hidden", timeout=1e3 * START_S)
    yield Person(page, pictures)
    page.close()
    assert not wrong


def test_the_page_shows_the_arm_and_its_vein(person: Person) -> None:
    person.settle()
    image = person.image()
    assert image.shape == (512 // STEP, 512 // STEP)
    assert image.std() > 20
    assert person.vein() > 1000 / STEP**2
    assert person.page.evaluate("usSim.scene()") == "upper arm"
    person.picture("start")


def test_dragging_the_probe_down_closes_the_vein_and_letting_go_opens_it(person: Person) -> None:
    before = person.vein()
    person.page.get_by_role("button", name="Look under the skin").click()
    person.drag_down(150)
    assert person.vein() < 0.35 * before
    person.picture("press")
    person.go_home()
    assert person.vein() > 0.8 * before
    person.page.get_by_role("button", name="Look under the skin").click()
