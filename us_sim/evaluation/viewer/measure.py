"""Run the arm with a viewer, and show it in a real browser.

>>> from us_sim.evaluation.viewer.measure import list_cases
>>> [str(case) for case in list_cases(quick=True)][:2]
['no viewer, path', 'viewer without a page, path']
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from us_sim.errors import UsSimError
from us_sim.evaluation.processes import (
    SimulatorProcess,
    UsageOverTime,
    record_arrivals,
    run_simulator,
)
from us_sim.evaluation.report import compute_percentile
from us_sim.share import find_bag


@dataclass(frozen=True)
class ViewerCase:
    """One way to run the scene ``upper_arm`` with `us-sim`."""

    who: str  # "no viewer", "viewer without a page", or "1 browser"
    by_hand: bool = False  # a page moves the probe; else a path is played at 60 Hz
    seconds: float = 20.0

    def __str__(self) -> str:
        return f"{self.who}, {'hand' if self.by_hand else 'path'}"


def list_cases(quick: bool) -> list[ViewerCase]:
    """List the cases; in a quick run each takes some seconds."""
    chosen = [
        ViewerCase("no viewer"),
        ViewerCase("viewer without a page"),
        ViewerCase(BROWSER, seconds=130.0),
        ViewerCase(BROWSER, by_hand=True),
    ]
    return [replace(case, seconds=8.0) for case in chosen] if quick else chosen


BROWSER = "1 browser"
"""A page in headless Chromium, which draws with the processor."""
MOVE = """([x, y, seconds]) => new Promise((resolve) => {
    const target = document.elementFromPoint(x, y);
    const began = performance.now();
    const timer = setInterval(() => {
        const passed = (performance.now() - began) / 1000;
        const down = 45 * (1 - Math.cos(Math.PI * passed));
        target.dispatchEvent(new PointerEvent("pointermove", {
            pointerId: 1, pointerType: "mouse", isPrimary: true, buttons: 1, bubbles: true,
            clientX: x, clientY: y + down,
        }));
        if (passed < seconds) return;
        clearInterval(timer);
        resolve();
    }, 1000 / 60);
})"""
"""A drag of 90 CSS pixels and back in 2 s, within the page: from outside it would be slow."""


@contextlib.contextmanager
def show_page(simulation: SimulatorProcess) -> Iterator[BrowserPage]:
    """Show the simulation's page in Chromium.

    Raises:
        UsSimError: Chromium or playwright is not installed.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise UsSimError("playwright is missing: pip install playwright") from error
    chromium = os.environ.get("US_SIM_TEST_CHROMIUM") or shutil.which("chromium")
    if not chromium:
        raise UsSimError("there is no chromium on PATH: install it to have it measured")
    while not (found := _ADDRESS.search(simulation.read_output())):
        simulation.require_running()
        time.sleep(0.005)
    with sync_playwright() as tool:
        # As without a graphics card.
        drawing = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        arguments = [*drawing, "--disable-gpu-compositing"]
        browser = tool.chromium.launch(executable_path=chromium, args=arguments)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        began = time.monotonic()
        page.goto(found[0])
        page.wait_for_function("window.usSim?.images?.() > 0", timeout=60_000)
        shown = time.monotonic()
        yield BrowserPage(page, opened=shown - began, started=shown - simulation.began)
        browser.close()


@dataclass
class BrowserPage:
    """A page in a browser, or none; then nothing is shown."""

    page: Any = None
    opened: float = math.nan  # s, from opening the page to its first image
    started: float = math.nan  # s, from the command to the first image

    def count_images(self) -> float:
        """Count the images that the page has drawn."""
        return float(self.page.evaluate("window.usSim.images()")) if self.page else math.nan

    def wait_or_drag(self, seconds: float, *, drag: bool) -> None:
        """Wait for some seconds, or drag the probe with the mouse over the page's image."""
        if not self.page:
            time.sleep(max(seconds, 0.0))
            return
        if not drag:
            self.page.wait_for_timeout(1e3 * seconds)
            return
        box = self.page.locator(".us-image").bounding_box()
        x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.3 * box["height"]
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        self.page.evaluate(MOVE, [x, y, seconds])
        self.page.mouse.up()

    def read_delays(self) -> dict[str, float]:
        """Read delays (ms) from the pointer to the pixels: median, 99th percentile, and count."""
        found = self.page.evaluate("window.usSim.latency()") if self.page else {}
        return {
            name: float((found or {}).get(name) or math.nan) for name in ("median", "p99", "count")
        }


_ADDRESS = re.compile(r"http://\S+")


def run_case(case: ViewerCase) -> list[dict[str, Any]]:
    """Run the arm as in the case, and return its row.

    Raises:
        UsSimError: the simulation ends, or no image comes.
    """
    path = ["--path", str(find_bag("press_and_slide.mcap")), "--param", "path_player.loop=true"]
    command = ["run"] if case.who == "no viewer" else ["view", "--port", "0"]
    with (
        record_arrivals() as arrivals,
        run_simulator(*command, "upper_arm", *([] if case.by_hand else path)) as simulation,
        show_page(simulation)
        if case.who == BROWSER
        else contextlib.nullcontext(BrowserPage()) as page,
    ):
        simulation.await_image(arrivals)
        page.wait_or_drag(2.0, drag=case.by_hand)  # these images do not count
        usage = UsageOverTime(os.getpid())  # browsers, too
        began, began_ns, shown = time.monotonic(), time.time_ns(), page.count_images()
        while (passed := time.monotonic() - began) < case.seconds:
            simulation.require_running()
            usage.update()
            page.wait_or_drag(min(2.0, case.seconds - passed), drag=case.by_hand)
        ended_ns, seconds = time.time_ns(), time.monotonic() - began
        drawn, delays = page.count_images() - shown, page.read_delays()
        messages = arrivals.list_arrivals_between(began_ns, ended_ns)
    images = {stamp for stamp, _ in messages["ultrasound/image"]}
    poses = {stamp for stamp, _ in messages["tracker/pose"]}
    ages = [1e-6 * (came - stamp) for stamp, came in messages["ultrasound/image"]]
    used = usage.make_columns()
    return [
        {
            "images_a_second_made": len(images) / seconds,
            "poses_skipped_percent": 100.0 * len(poses - images) / max(len(poses), 1),
            "image_age_ms_p50": compute_percentile(ages, 50),
            "image_age_ms_p99": compute_percentile(ages, 99),
            "images_a_second_shown": drawn / seconds,
            "delay_ms_median": delays["median"],
            "delay_ms_p99": delays["p99"],
            "delays": delays["count"],
            "start_s": page.started,
            "page_opened_s": page.opened,
            **{
                f"{part}_{name}": used.get(f"{part}_{name}", math.nan)
                for part in ("cores", "memory_mb", "growth_mb_a_minute")
                for name in ("viewer", "browser")
            },
        }
    ]
