"""`us-sim view --path`, open to other computers: path and viewer end, and the session goes on."""

import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from awaiting import until
from chromium import watched
from many_restarts import nodes_of
from served_view import START_S, served_view

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")
ENDED_AT = -1.0
"""mm, how deep the short path presses at its end; a hand that knows no better begins at +1."""

PRESSED = """import("/us_sim/assets/hand/hand.js").then(
    ({ hand }) => Number((1000 * hand.state.stance.press).toFixed(2)))"""
"""mm: how deep the probe has come, where the field says how deep it shall."""


@pytest.fixture
def run(small_scene: Path, short_path: Path, tmp_path: Path) -> Iterator[Any]:
    """The command's process, what it says, and the address that it prints."""
    words = (small_scene, "--path", short_path, "--host", "0.0.0.0")
    with served_view(tmp_path, *words) as served:
        served.address = re.sub(r"//[^:/]+", "//127.0.0.1", served.address)
        yield served


def test_the_session_outlives_its_path_and_its_viewer(browser: Any, run: Any) -> None:
    token = run.address.partition("token=")[2]
    assert len(token) >= 16
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    watched(page, run.address.partition("?")[0], [])
    page.goto(run.address)
    told = page.locator("#hand [role=status]")
    press = page.get_by_role("spinbutton", name="Press")
    until(lambda: "has ended and holds the probe" in told.inner_text(), "the path ends", START_S)
    until(lambda: float(press.input_value() or 9) == ENDED_AT, "the page shows where it ended")
    assert press.is_disabled()

    page.get_by_role("button", name="Take the probe").click()
    until(lambda: "You hold the probe" in told.inner_text(), "the person has the probe")
    assert float(press.input_value()) == ENDED_AT
    press.fill("3.5")
    press.press("Enter")
    press.blur()
    until(lambda: page.evaluate(PRESSED) == 3.5, "the probe is where it was put")

    before = nodes_of(run.process.pid)["viewer"]
    command_line = Path(f"/proc/{before}/cmdline").read_bytes().decode()
    assert token not in command_line
    page.evaluate("window.isOld = true")
    os.kill(before, signal.SIGKILL)
    until(
        lambda: nodes_of(run.process.pid).get("viewer", before) != before,
        "the viewer is started again",
    )
    until(lambda: not _is_old(page), "the page is loaded anew")
    until(lambda: "You hold the probe" in told.inner_text(), "the person has the probe again")
    assert float(press.input_value()) == 3.5
    other = browser.new_context().new_page()  # with no cookie
    answer = other.goto(run.address)
    assert answer is not None
    assert answer.status == 200
    other.context.close()
    page.close()
    assert run.process.poll() is None


def _is_old(page: Any) -> bool:
    """Whether the page was never loaded again; True while it cannot be asked."""
    try:
        return bool(page.evaluate("window.isOld === true || !document.querySelector('#hand')"))
    except Exception:  # it is being loaded
        return True
