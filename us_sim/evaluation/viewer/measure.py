"""Run the arm with a viewer, and look at it with real browsers.

>>> from us_sim.evaluation.viewer.measure import cases
>>> [str(case) for case in cases(quick=True)][:2]
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
from us_sim.evaluation.processes import Simulation, UsageOverTime, listening, simulating
from us_sim.evaluation.report import percentile
from us_sim.share import find_bag


@dataclass(frozen=True)
class Case:
    """One way to run the scene ``upper_arm`` with `us-sim`."""

    viewer: bool = True  # the node runs
    browsers: int = 0  # pages in a Chromium without a window, which draws with the processor
    by_hand: bool = False  # a page moves the probe; else a path is played at 60 Hz
    seconds: float = 20.0

    def __str__(self) -> str:
        page = "1 browser" if self.browsers == 1 else f"{self.browsers} browsers"
        without = "viewer without a page" if self.viewer else "no viewer"
        pages = [page if self.browsers else without]
        return ", ".join([*pages, "hand" if self.by_hand else "path"])


def cases(quick: bool) -> list[Case]:
    """Cases of a run; in a quick one each takes some seconds."""
    chosen = [
        Case(viewer=False),
        Case(),
        Case(browsers=1, seconds=130.0),
        Case(browsers=1, by_hand=True),
        Case(browsers=2),
    ]
    return [replace(case, seconds=8.0) for case in chosen] if quick else chosen


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


@contextlib.contextmanager
def showing(count: int, simulation: Simulation) -> Iterator[Pages]:
    """Show so many pages of the simulation in one Chromium; none needs none.

    Raises:
        UsSimError: Chromium or playwright is not installed.
    """
    if not count:
        yield Pages([])
        return
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise UsSimError("playwright is missing: pip install playwright") from error
    chromium = os.environ.get("US_SIM_TEST_CHROMIUM") or shutil.which("chromium")
    if not chromium:
        raise UsSimError("there is no chromium on PATH: install it to have it measured")
    while not (found := _ADDRESS.search(simulation.said())):
        simulation.check()
        time.sleep(0.005)
    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        shown = Pages([])
        for _ in range(count):
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            began = time.monotonic()
            page.goto(found[0])
            page.wait_for_function("window.usSim?.images?.() > 0", timeout=60_000)
            if not shown.pages:
                shown.opened = time.monotonic() - began
                shown.started = time.monotonic() - simulation.began
            shown.pages.append(page)
        yield shown
        browser.close()


@dataclass
class Pages:
    """Pages in a browser."""

    pages: list[Any]
    opened: float = math.nan  # s, from opening the first page to its first image
    started: float = math.nan  # s, likewise, from the command

    def images(self) -> list[int]:
        """How many images each page has drawn."""
        return [int(page.evaluate("window.usSim.images()")) for page in self.pages]

    def wait(self, seconds: float, *, drag: bool) -> None:
        """Let so long pass, dragging the probe with the mouse over the first page's image."""
        if not self.pages:
            time.sleep(max(seconds, 0.0))
            return
        page = self.pages[0]
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
        found = self.pages[0].evaluate("window.usSim.latency()") if self.pages else {}
        return {
            name: float((found or {}).get(name) or math.nan) for name in ("median", "p99", "count")
        }


_ADDRESS = re.compile(r"http://\S+")


def run_case(case: Case) -> list[dict[str, Any]]:
    """Look at the arm as the case says, and return its row.

    Raises:
        UsSimError: the simulation ends, or no image comes.
    """
    path = ["--path", str(find_bag("press_and_slide.mcap")), "--param", "path_player.loop=true"]
    words = ["view" if case.viewer else "run", "upper_arm", *([] if case.by_hand else path)]
    words += ["--port", "0"] if case.viewer else []
    with (
        listening() as arrivals,
        simulating(*words) as simulation,
        showing(case.browsers, simulation) as pages,
    ):
        simulation.await_images(arrivals)
        pages.wait(2.0, drag=case.by_hand)  # these images do not count
        usage = UsageOverTime(os.getpid())  # browsers, too
        began, began_ns, shown = time.monotonic(), time.time_ns(), pages.images()
        while (passed := time.monotonic() - began) < case.seconds:
            simulation.check()
            usage.update()
            pages.wait(min(2.0, case.seconds - passed), drag=case.by_hand)
        ended_ns, seconds = time.time_ns(), time.monotonic() - began
        drawn = [(b - a) / seconds for a, b in zip(shown, pages.images(), strict=True)]
        delays = pages.delays()
        heard = arrivals.heard_between(began_ns, ended_ns)
    images = {stamp for stamp, _ in heard["ultrasound/image"]}
    poses = {stamp for stamp, _ in heard["tracker/pose"]}
    ages = [1e-6 * (came - stamp) for stamp, came in heard["ultrasound/image"]]
    used = usage.columns()
    return [
        {
            "images_a_second_made": len(images) / seconds,
            "poses_skipped_percent": 100.0 * len(poses - images) / max(len(poses), 1),
            "image_age_ms_p50": percentile(ages, 50),
            "image_age_ms_p99": percentile(ages, 99),
            "images_a_second_shown": min(drawn, default=math.nan),  # in the page with the fewest
            "delay_ms_median": delays["median"],
            "delay_ms_p99": delays["p99"],
            "delays": delays["count"],
            "start_s": pages.started,
            "page_opened_s": pages.opened,
            **{
                f"{part}_{name}": used.get(f"{part}_{name}", math.nan)
                for part in ("cores", "memory_mb", "growth_mb_a_minute")
                for name in ("viewer", "browser")
            },
            "memory": usage.table(),
        }
    ]
