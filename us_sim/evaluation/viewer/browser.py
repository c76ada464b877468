"""Pages in a real Chromium without a window, whose probe a mouse drags."""

from __future__ import annotations

import math
import os
import shutil
import time
from typing import Any

from us_sim.errors import UsSimError

ARGUMENTS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",  # as where there is no graphics card
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
DRAG, PERIOD, RATE = 90.0, 2.0, 60.0
"""CSS pixels and s of the drag that is repeated, and how often the mouse tells where it is, Hz."""
MOVE = """([x, y, seconds, drag, period, rate]) => new Promise((resolve) => {
    const target = document.elementFromPoint(x, y);
    const began = performance.now();
    const timer = setInterval(() => {
        const passed = (performance.now() - began) / 1000;
        const down = 0.5 * drag * (1 - Math.cos((2 * Math.PI * passed) / period));
        target.dispatchEvent(new PointerEvent("pointermove", {
            pointerId: 1, pointerType: "mouse", isPrimary: true, buttons: 1, bubbles: true,
            clientX: x, clientY: y + down,
        }));
        if (passed < seconds) return;
        clearInterval(timer);
        resolve();
    }, 1000 / rate);
})"""
"""Moves of the mouse, made within the page: from outside each would take longer than an image."""


class Browser:
    """One Chromium with some pages.

    Args:
        address: that they show.
        pages: how many.

    Raises:
        UsSimError: there is none here.
    """

    def __init__(self, address: str, pages: int) -> None:
        try:
            from playwright.sync_api import sync_playwright
        except ImportError as error:
            raise UsSimError("playwright is missing: pip install playwright") from error
        chromium = os.environ.get("US_SIM_TEST_CHROMIUM") or shutil.which("chromium")
        if not chromium:
            raise UsSimError("there is no chromium on PATH: install it to have it measured")
        self._tool = sync_playwright().start()
        self._browser = self._tool.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        self.first_image = math.nan  # s from opening the first page
        self._pages: list[Any] = []
        for _ in range(pages):
            page = self._browser.new_page(viewport={"width": 1280, "height": 720})
            began = time.monotonic()
            page.goto(address)
            page.wait_for_function("window.usSim?.images?.() > 0", timeout=60_000)
            if not self._pages:
                self.first_image = time.monotonic() - began
            self._pages.append(page)

    def images(self) -> list[int]:
        """How many images each page has drawn."""
        return [int(page.evaluate("window.usSim.images()")) for page in self._pages]

    def wait(self, seconds: float, *, drag: bool) -> None:
        """Let so long pass, dragging the probe with the mouse over the first page's image."""
        page = self._pages[0]
        if not drag:
            page.wait_for_timeout(1e3 * seconds)
            return
        box = page.locator(".us-image").bounding_box()
        x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.3 * box["height"]
        page.mouse.move(x, y)
        page.mouse.down()
        page.evaluate(MOVE, [x, y, seconds, DRAG, PERIOD, RATE])
        page.mouse.up()

    def delays(self) -> dict[str, float]:
        """ms from the pointer to the pixels: median and 99th percentile, and how many there are."""
        found = self._pages[0].evaluate("window.usSim.latency()") or {}
        return {name: float(found.get(name) or math.nan) for name in ("median", "p99", "count")}

    def close(self) -> None:
        """End it."""
        self._browser.close()
        self._tool.stop()
