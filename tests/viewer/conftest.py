"""A page server whose sources are the test's own."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from bench import Bench
from chromium import watched

from us_sim.viewer.stream import PageSources

EMPTY = '<link rel="icon" href="data:,">'
"""A document in which nothing runs and which asks for nothing."""


@pytest.fixture
def bench() -> Iterator[Bench]:
    """A bench of nodes that is taken down after the test."""
    bench = Bench()
    yield bench
    bench.close()


@pytest.fixture(scope="session")
def served() -> Iterator[Any]:
    """The one server that a process may have; its sources are emptied for each test."""
    pytest.importorskip("nicegui", reason="nicegui is not installed")
    from us_sim.viewer.server import WebServer

    sources = PageSources()
    server = WebServer(sources, port=0)
    yield server, sources
    server.close()


@pytest.fixture
def sources(served: Any) -> PageSources:
    """The sources of :func:`page`, which shows nothing yet."""
    _, sources = served
    empty = PageSources()
    for name, value in vars(empty).items():
        setattr(sources, name, value)
    return sources


@pytest.fixture(scope="session")
def profile(browser: Any) -> Any:
    """A person's browser, which loads the page's files once."""
    return browser.new_context(viewport={"width": 1280, "height": 720})


@pytest.fixture(scope="session")
def tabs(profile: Any, served: Any) -> Callable[[], tuple[Any, list[str]]]:
    """Returns a tab, and what is wrong in it: the last one while it is open, a new one otherwise.

    A tab that has compiled the page's scripts loads it again in half the time. It is closed after
    some tests, since it takes more and more memory.
    """
    tabs: list[tuple[Any, list[str]]] = []
    tests = 0

    def tab() -> tuple[Any, list[str]]:
        nonlocal tests
        tests += 1
        if tabs and tests % 25 == 0:
            tabs[-1][0].close()
        if not tabs or tabs[-1][0].is_closed():
            page, wrong = profile.new_page(), list[str]()
            page.address = served[0].addresses[0]
            page.route(
                f"{page.address}/empty",
                lambda route: route.fulfill(body=EMPTY, content_type="text/html"),
            )
            watched(page, page.address, wrong)
            tabs.append((page, wrong))
        return tabs[-1]

    return tab


@pytest.fixture
def page(tabs: Any, sources: PageSources) -> Iterator[Any]:  # noqa: ARG001
    """A page of 1280 × 720 that is not loaded yet: ``page.goto(page.address)`` does.

    Afterwards it is refused what no page may have: errors, on the console or otherwise, and
    requests that go beyond the viewer.
    """
    page, wrong = tabs()
    wrong.clear()
    page.set_viewport_size({"width": 1280, "height": 720})
    page.emulate_media(reduced_motion="null")
    yield page
    if not page.is_closed():
        page.goto(f"{page.address}/empty")
        page.evaluate("sessionStorage.clear()")  # or the next page would be the same hand
        page.mouse.up()
        for key in ("Alt", "Control", "Meta", "Shift"):
            page.keyboard.up(key)
    assert not wrong
