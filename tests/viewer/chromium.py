"""A real Chromium, without a window and without a graphics card."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

ARGUMENTS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",  # as where there is no graphics card
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
PROGRAMS = ("chromium-headless-shell", "chromium")
"""The first has no window of its own to draw."""


@contextmanager
def chromium() -> Iterator[Any]:
    """The browser; where there is none the test is skipped."""
    found = [os.environ.get("US_SIM_TEST_CHROMIUM"), *map(shutil.which, PROGRAMS)]
    program = next(filter(None, found), None)
    if not program:
        pytest.skip(f"neither {' nor '.join(PROGRAMS)} on PATH, nor US_SIM_TEST_CHROMIUM")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        yield browser
        browser.close()


def watched(page: Any, address: str, wrong: list[str]) -> None:
    """Have what no page may do noted: errors, and requests that go beyond the viewer."""
    allowed = (address, "data:", "blob:", "ws:")
    page.on("console", lambda said: said.type == "error" and wrong.append(said.text))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on(
        "request",
        lambda asked: asked.url.startswith(allowed) or wrong.append(f"asked for {asked.url}"),
    )
