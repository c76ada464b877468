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
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

from us_sim.errors import UsSimError
from us_sim.evaluation.processes import UsageByName, UsageOverTime, listening, started_by
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
        Case(browsers=1),
        Case(browsers=1, by_hand=True),
        Case(browsers=2),
    ]
    if quick:
        return [replace(case, seconds=8.0) for case in chosen]
    return [*chosen, Case(browsers=1, seconds=600.0)]


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
def showing(count: int, command: _Command) -> Iterator[Pages]:
    """Show so many pages of the command in one Chromium; none needs none.

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
    address = command.address()
    with sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        shown = Pages([])
        for _ in range(count):
            page = browser.new_page(viewport={"width": 1280, "height": 720})
            began = time.monotonic()
            page.goto(address)
            page.wait_for_function("window.usSim?.images?.() > 0", timeout=60_000)
            if not shown.pages:
                shown.opened = time.monotonic() - began
                shown.started = time.monotonic() - command.began
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
    with (
        listening(viewer=False) as arrivals,
        _command(case) as command,
        showing(case.browsers, command) as pages,
    ):
        deadline = time.monotonic() + 300.0  # the first run compiles
        while not arrivals.heard("ultrasound/image"):
            command.check()
            if time.monotonic() > deadline:
                raise UsSimError("no image came in 300 s")
            time.sleep(0.02)
        pages.wait(2.0, drag=case.by_hand)  # these images do not count
        usage = UsageByName()
        began, began_ns, shown = time.monotonic(), time.time_ns(), pages.images()
        while (passed := time.monotonic() - began) < case.seconds:
            command.check()
            usage.update(started_by(command.process.pid) | started_by(os.getpid()))
            pages.wait(min(2.0, case.seconds - passed), drag=case.by_hand)
        ended_ns, seconds = time.time_ns(), time.monotonic() - began
        drawn = [(b - a) / seconds for a, b in zip(shown, pages.images(), strict=True)]
        delays = pages.delays()
        heard = arrivals.heard_between(began_ns, ended_ns)
    images = {stamp for stamp, _ in heard["ultrasound/image"]}
    poses = {stamp for stamp, _ in heard["tracker/pose"]}
    ages = [1e-6 * (came - stamp) for stamp, came in heard["ultrasound/image"]]
    uses = {name: usage.uses.get(name, UsageOverTime()) for name in ("viewer", "browser")}
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
            **{f"cores_{name}": use.processor for name, use in uses.items()},
            **{f"memory_mb_{name}": 1e-6 * use.memory for name, use in uses.items()},
            **{f"growth_mb_a_minute_{name}": 1e-6 * use.growth for name, use in uses.items()},
            "memory": [
                {"process": name, "s": at, "MB": 1e-6 * each.memory}
                for name, use in usage.uses.items()
                for at, each in zip(use.times, use.uses, strict=True)
            ],
        }
    ]


@dataclass
class _Command:
    """`us-sim run` or `us-sim view` in a process of its own."""

    process: subprocess.Popen[bytes]
    output: IO[bytes]
    began: float

    def said(self) -> str:
        """Output so far."""
        return Path(self.output.name).read_text(encoding="utf-8", errors="replace")

    def check(self) -> None:
        """Raise UsSimError when it has ended."""
        if self.process.poll() is not None:
            lines = self.said().strip().splitlines()
            raise UsSimError(f"us-sim has ended{': ' if lines else ''}{''.join(lines[-1:])}")

    def address(self) -> str:
        """Address of the page, once it is printed."""
        while not (found := _ADDRESS.search(self.said())):
            self.check()
            if time.monotonic() - self.began > 300.0:
                raise UsSimError("us-sim has printed no address in 300 s")
            time.sleep(0.005)
        return found[0]


@contextlib.contextmanager
def _command(case: Case) -> Iterator[_Command]:
    """The simulation, which ends with the context."""
    path = ["--path", str(find_bag("press_and_slide.mcap")), "--param", "path_player.loop=true"]
    words = ["view" if case.viewer else "run", "upper_arm", *([] if case.by_hand else path)]
    words += ["--port", "0"] if case.viewer else []
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    with tempfile.NamedTemporaryFile(prefix="us_sim_viewer_") as output:
        began = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "us_sim", *words],
            env=environment,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            yield _Command(process, output, began)
        finally:
            process.send_signal(signal.SIGINT)
            killer = threading.Timer(20.0, process.kill)
            killer.start()
            process.wait()
            killer.cancel()
