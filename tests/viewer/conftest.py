"""A page server whose simulator is the test's own."""

from collections.abc import Iterator
from typing import Any

import pytest
from bench import Bench
from chromium import watched

from us_sim.viewer.stream import Simulator


@pytest.fixture
def bench() -> Iterator[Bench]:
    """A bench of nodes that is taken down after the test."""
    bench = Bench()
    yield bench
    bench.close()


@pytest.fixture(scope="session")
def served() -> Iterator[Any]:
    """The one server that a process may have; its simulator is emptied for each test."""
    pytest.importorskip("nicegui", reason="nicegui is not installed")
    from us_sim.viewer.server import WebServer

    simulator = Simulator()
    server = WebServer(simulator, port=0)
    yield server, simulator
    server.close()


@pytest.fixture
def simulator(served: Any) -> Simulator:
    """What the page of :func:`page` shows: nothing yet."""
    _, simulator = served
    empty = Simulator()
    for name, value in vars(empty).items():
        setattr(simulator, name, value)
    return simulator


@pytest.fixture(scope="session")
def profile(browser: Any) -> Any:
    """A person's browser, which loads the page's files once."""
    return browser.new_context(viewport={"width": 1280, "height": 720})


@pytest.fixture
def page(profile: Any, served: Any, simulator: Simulator) -> Iterator[Any]:  # noqa: ARG001
    """A page of 1280 × 720 that is not loaded yet: ``page.goto(page.address)`` does.

    Afterwards it is refused what no page may have: errors, on the console or otherwise, and
    requests that go beyond the viewer.
    """
    server, _ = served
    page = profile.new_page()
    page.address = server.address
    wrong: list[str] = []
    watched(page, server.address, wrong)
    yield page
    page.close()
    assert not wrong
