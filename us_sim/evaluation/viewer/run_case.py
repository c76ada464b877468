"""Runs the arm in one way, and looks at it."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from us_sim.errors import UsSimError
from us_sim.evaluation.latency.listener import listening
from us_sim.evaluation.timed_cases import Tell
from us_sim.evaluation.viewer.browser import Browser
from us_sim.evaluation.viewer.cases import Case
from us_sim.evaluation.viewer.points import Point
from us_sim.evaluation.viewer.processes import UsageByName, started_by
from us_sim.evaluation.viewer.taker import Taker
from us_sim.share import find_bag

_START_S = 300.0  # the first run compiles
_WARMING_S = 2.0  # of images that do not count
_STOP_S = 20.0
_SAMPLE_S = 2.0
_ADDRESS = re.compile(r"http://\S+")


def run_case(case: Case, tell: Tell) -> Point:
    """What the case shows.

    Args:
        case: how to look at the arm.
        tell: is told how many of the case's seconds are over.

    Raises:
        UsSimError: the simulation ends, or no image comes.
    """
    tell(0.0, "starting")
    with listening(viewer=False) as arrivals, _command(case) as command:
        pages = _Pages(case, command)
        try:
            deadline = time.monotonic() + _START_S
            while not arrivals.heard("ultrasound/image") and not pages.images():
                command.check()
                if time.monotonic() > deadline:
                    raise UsSimError(f"no image came in {_START_S:g} s")
                time.sleep(0.02)
            pages.wait(_WARMING_S)
            usage = UsageByName()
            began, began_ns, shown = time.monotonic(), time.time_ns(), pages.images()
            while (passed := time.monotonic() - began) < case.seconds:
                command.check()
                usage.look(started_by(command.pid) | started_by(os.getpid()))
                tell(passed, f"{len(arrivals.heard('ultrasound/image'))} images")
                pages.wait(min(_SAMPLE_S, case.seconds - passed))
            ended_ns, seconds = time.time_ns(), time.monotonic() - began
            drawn = [(b - a) / seconds for a, b in zip(shown, pages.images(), strict=True)]
            median, p99, count = pages.delays()
        finally:
            pages.close()
        heard = {
            topic: [each for each in arrivals.heard(topic) if began_ns <= each[0] < ended_ns]
            for topic in ("tracker/pose", "ultrasound/image")
        }
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
    """Those that look, of both kinds."""

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
        """How many each has got."""
        drawn = self._browser.images() if self._browser else []
        return [*drawn, *(len(taker.images) for taker in self._takers)]

    def wait(self, seconds: float) -> None:
        """Let time pass; a mouse may move meanwhile."""
        if self._browser:
            self._browser.wait(seconds, drag=self._case.by_hand)
        else:
            time.sleep(max(seconds, 0.0))

    def delays(self) -> Sequence[float]:
        """Median, 99th percentile, and number of those that were measured."""
        if self._browser:
            found = self._browser.delays()
            return found["median"], found["p99"], found["count"]
        delays = [delay for taker in self._takers for delay in taker.delays]
        if not delays:
            return np.nan, np.nan, np.nan
        return float(np.median(delays)), float(np.percentile(delays, 99)), float(len(delays))

    def close(self) -> None:
        """Close them."""
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
        """All that it has written."""
        return Path(self.output.name).read_text(encoding="utf-8", errors="replace")

    def check(self) -> None:
        """Raise UsSimError when it has ended."""
        if self.process.poll() is not None:
            raise UsSimError(f"us-sim has ended: {self.said().strip().splitlines()[-1:]}")

    def address(self) -> str:
        """That it has printed."""
        while not (found := _ADDRESS.search(self.said())):
            self.check()
            if time.monotonic() - self.began > _START_S:
                raise UsSimError(f"us-sim has printed no address in {_START_S:g} s")
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
            killer = threading.Timer(_STOP_S, process.kill)
            killer.start()
            process.wait()
            killer.cancel()
