"""Run the arm with a viewer, and look at it with pages that only take, and with real browsers.

>>> from us_sim.evaluation.viewer.measure import cases
>>> [str(case) for case in cases(quick=True)][:2]
['no viewer, path', 'viewer without a page, path']
"""

from __future__ import annotations

import contextlib
import json
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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from us_sim.errors import UsSimError
from us_sim.evaluation.processes import UsageByName, UsageOverTime, listening, started_by
from us_sim.evaluation.report import Row, percentile
from us_sim.evaluation.timing import Tell
from us_sim.share import find_bag

if TYPE_CHECKING:
    from us_sim.viewer.stream import Packet


@dataclass(frozen=True)
class Case:
    """One way to run the scene ``upper_arm`` with `us-sim`."""

    viewer: bool = True  # the node runs
    takers: int = 0  # pages that take everything that streams, and do not draw it
    browsers: int = 0  # pages in a Chromium without a window, which draws with the processor
    by_hand: bool = False  # a page moves the probe; else a path is played at 60 Hz
    seconds: float = 20.0

    def __str__(self) -> str:
        takers = "page that takes" if self.takers == 1 else "pages that take"
        browsers = "browser" if self.browsers == 1 else "browsers"
        counted = [(self.takers, takers), (self.browsers, browsers)]
        pages = [f"{count} {name}" for count, name in counted if count]
        pages = pages or ["viewer without a page" if self.viewer else "no viewer"]
        return ", ".join([*pages, "hand" if self.by_hand else "path"])


def cases(quick: bool) -> list[Case]:
    """Cases of a run; in a quick one each takes some seconds."""
    chosen = [
        Case(viewer=False),
        Case(),
        Case(takers=1),
        Case(takers=2),
        Case(takers=1, by_hand=True),
        Case(browsers=1),
        Case(browsers=1, by_hand=True),
        Case(browsers=2),
    ]
    if quick:
        return [replace(case, seconds=8.0) for case in chosen]
    return [*chosen, Case(browsers=1, seconds=600.0)]


@dataclass(frozen=True)
class Point(Row):
    """A row of viewer.csv."""

    case: Case
    made: float = np.nan  # images a second of the simulator
    skipped: float = np.nan  # of 100 poses those without an image
    ages: Sequence[float] = ()  # ms, from a pose to its image in the graph
    shown: float = np.nan  # images a second in the page that gets the fewest
    delay_median: float = np.nan  # ms, from a person's action to the image in the page
    delay_p99: float = np.nan
    delays: float = np.nan  # how many of these there are
    started: float = np.nan  # s, from the command to the first image in a page
    opened: float = np.nan  # s, from opening the page in a browser to its first image
    usage: Mapping[str, UsageOverTime] = field(default_factory=dict)  # by the process's name
    failure: str = ""

    @property
    def title(self) -> str:
        return str(self.case)

    @property
    def values(self) -> dict[str, object]:
        use = self.usage
        return {
            "case": str(self.case),
            "seconds": self.case.seconds,
            "images_a_second_made": self.made,
            "poses_skipped_percent": self.skipped,
            "image_age_ms_p50": self.age(50),
            "image_age_ms_p99": self.age(99),
            "images_a_second_shown": self.shown,
            "delay_ms_median": self.delay_median,
            "delay_ms_p99": self.delay_p99,
            "delays": self.delays,
            "start_s": self.started,
            "page_opened_s": self.opened,
            "cores_viewer": self.cores("viewer"),
            "cores_browser": self.cores("browser"),
            "memory_mb_viewer": 1e-6 * use["viewer"].memory if "viewer" in use else np.nan,
            "memory_mb_browser": 1e-6 * use["browser"].memory if "browser" in use else np.nan,
            "growth_mb_a_minute_viewer": self.growth("viewer"),
            "growth_mb_a_minute_browser": self.growth("browser"),
            "failure": self.failure,
        }

    def age(self, percent: float) -> float:
        """Percentile of the images' ages, ms."""
        return percentile(self.ages, percent)

    def cores(self, name: str) -> float:
        """Processor time over time of the processes of a name."""
        return self.usage[name].processor if name in self.usage else np.nan

    def growth(self, name: str) -> float:
        """MB a minute after the first minute; NaN in a short run."""
        return 1e-6 * self.usage[name].growth if name in self.usage else np.nan


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
        UsSimError: Chromium or playwright is not installed.
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
        """Close the browser."""
        self._browser.close()
        self._tool.stop()


STREAMED = ("image", "skin_mesh", "skin", "structures_mesh", "structures", "probe", "hand")
"""Contents of the page when it is opened."""
COMMAND_RATE = 60.0  # commands a second of a hand that moves
PRESS, PRESS_PERIOD = 0.006, 2.0  # m and s of the press that it repeats


class Taker:
    """One page, with a thread that takes and, if it moves the probe, one that asks.

    Args:
        address: of the viewer, as it was printed.
        by_hand: move the probe.

    Raises:
        UsSimError: it cannot be reached.
    """

    def __init__(self, address: str, *, by_hand: bool = False) -> None:
        try:
            from websockets.sync.client import connect
        except ImportError as error:
            raise UsSimError("this needs the viewer: pip install 'us_sim[viewer]'") from error
        self._stack = contextlib.ExitStack()
        host = address.partition("://")[2].partition("/")[0]
        try:
            self._socket = self._stack.enter_context(
                connect(f"ws://{host}/us_sim/stream", compression=None, max_size=2**26, max_queue=4)
            )
        except OSError as error:
            raise UsSimError(f"no viewer answers at {address} ({error})") from error
        self.images: list[tuple[int, int]] = []  # stamp and arrival, ns
        self.delays: list[float] = []  # ms from a command to the first image that contains it
        self.bytes = 0
        self._asked: dict[int, int] = {}  # ns, by number
        self._answered = 0
        self._source = f"taker {id(self)}"
        self._lock = threading.Lock()
        self._socket.send(json.dumps({"watch": list(STREAMED)}))
        self._open = True
        self._threads = [threading.Thread(target=self._take, daemon=True)]
        if by_hand:
            self._threads.append(threading.Thread(target=self._move, daemon=True))
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Close the connection, and end the threads."""
        self._open = False
        self._stack.close()
        for thread in self._threads:
            thread.join(2.0)

    def _send(self, message: dict[str, Any]) -> None:
        with self._lock:
            self._socket.send(json.dumps(message))

    def _take(self) -> None:
        from us_sim.viewer.stream import Packet

        try:
            for data in self._socket:
                if isinstance(data, str):
                    continue
                now = time.time_ns()
                packet = Packet.decoded(data)
                self.bytes += len(data)
                if packet.kind == "image":
                    self._note(packet, now)
                self._send({"next": packet.kind})
        except Exception:
            if self._open:
                raise

    def _note(self, packet: Packet, now: int) -> None:
        self.images.append((int(packet.header["stamp"]), now))
        source, number = packet.header.get("command") or ("", 0)
        if source == self._source and number > self._answered:
            self._answered = number
            self.delays.append(1e-6 * (now - self._asked[number]))

    def _move(self) -> None:
        began, number = time.monotonic(), 0
        while self._open:
            number += 1
            phase = 2.0 * math.pi * (time.monotonic() - began) / PRESS_PERIOD
            press = 0.5 * PRESS * (1.0 - math.cos(phase))
            self._asked[number] = time.time_ns()
            command = {"source": self._source, "sequence": number, "to": {"press": press}}
            try:
                self._send({"hand": command})
            except Exception:
                return
            time.sleep(max(0.0, began + number / COMMAND_RATE - time.monotonic()))


_ADDRESS = re.compile(r"http://\S+")


def run_case(case: Case, tell: Tell) -> Point:
    """Look at the arm as the case says; ``tell`` is told how many of its seconds are over.

    Raises:
        UsSimError: the simulation ends, or no image comes.
    """
    tell(0.0, "starting")
    with listening(viewer=False) as arrivals, _command(case) as command:
        pages = _Pages(case, command)
        try:
            deadline = time.monotonic() + 300.0  # the first run compiles
            while not arrivals.heard("ultrasound/image") and not pages.images():
                command.check()
                if time.monotonic() > deadline:
                    raise UsSimError("no image came in 300 s")
                time.sleep(0.02)
            pages.wait(2.0)  # these images do not count
            usage = UsageByName()
            began, began_ns, shown = time.monotonic(), time.time_ns(), pages.images()
            while (passed := time.monotonic() - began) < case.seconds:
                command.check()
                usage.update(started_by(command.pid) | started_by(os.getpid()))
                tell(passed, f"{len(arrivals.heard('ultrasound/image'))} images")
                pages.wait(min(2.0, case.seconds - passed))
            ended_ns, seconds = time.time_ns(), time.monotonic() - began
            drawn = [(b - a) / seconds for a, b in zip(shown, pages.images(), strict=True)]
            median, p99, count = pages.delays()
        finally:
            pages.close()
        heard = arrivals.heard_between(began_ns, ended_ns)
    images = {stamp for stamp, _ in heard["ultrasound/image"]}
    poses = {stamp for stamp, _ in heard["tracker/pose"]}
    return Point(
        case,
        made=len(images) / seconds,
        skipped=100.0 * len(poses - images) / max(len(poses), 1),
        ages=[1e-6 * (came - stamp) for stamp, came in heard["ultrasound/image"]],
        shown=min(drawn, default=np.nan),
        delay_median=median,
        delay_p99=p99,
        delays=count,
        started=pages.started,
        opened=pages.opened,
        usage=usage.uses,
    )


class _Pages:
    """The pages of a case: those in a browser, and those that only take."""

    def __init__(self, case: Case, command: _Command) -> None:
        self._case = case
        self.started = self.opened = np.nan
        self._browser: Browser | None = None
        self._takers: list[Taker] = []
        if not case.takers and not case.browsers:
            return
        address = command.address()
        if case.browsers:
            self._browser = Browser(address, case.browsers)
            self.opened = self._browser.first_image
            self.started = time.monotonic() - command.began
        for i in range(case.takers):
            self._takers.append(Taker(address, by_hand=case.by_hand and i == 0))
        while self._takers and not self._takers[0].images:
            command.check()
            time.sleep(0.005)
            self.started = time.monotonic() - command.began

    def images(self) -> list[int]:
        """Number of images of each page."""
        drawn = self._browser.images() if self._browser else []
        return [*drawn, *(len(taker.images) for taker in self._takers)]

    def wait(self, seconds: float) -> None:
        """Let time pass; a mouse may move meanwhile."""
        if self._browser:
            self._browser.wait(seconds, drag=self._case.by_hand)
        else:
            time.sleep(max(seconds, 0.0))

    def delays(self) -> Sequence[float]:
        """Median and 99th percentile of the delays, ms, and their number."""
        if self._browser:
            found = self._browser.delays()
            return found["median"], found["p99"], found["count"]
        delays = [delay for taker in self._takers for delay in taker.delays]
        return percentile(delays, 50), percentile(delays, 99), len(delays) or np.nan

    def close(self) -> None:
        """Close all pages."""
        for taker in self._takers:
            taker.close()
        if self._browser:
            self._browser.close()


@dataclass
class _Command:
    """`us-sim run` or `us-sim view` in a process of its own."""

    process: subprocess.Popen[bytes]
    output: IO[bytes]
    began: float

    @property
    def pid(self) -> int:
        return self.process.pid

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
