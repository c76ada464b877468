"""The page without a browser, by which the viewer is measured."""

import time
from typing import Any

import pytest
from awaiting import until

from us_sim.errors import UsSimError
from us_sim.evaluation.viewer.measure import (
    Point,
    Taker,
    cases,
    run_case,  # noqa: F401 - it must be importable
)
from us_sim.evaluation.viewer.report import targets
from us_sim.viewer.stream import Feed, Packet, Simulator

DELAY_S = 0.05


def test_it_takes_what_streams_and_measures_how_long_a_command_takes(
    served: Any, simulator: Simulator
) -> None:
    """Commands are answered by images 50 ms later; half of them are not answered at all."""
    server, _ = served
    image = Feed("image", rate=None)
    simulator.add(image)

    def obey(command: Any, _: int) -> None:
        if command["sequence"] % 2:
            return
        time.sleep(DELAY_S)
        header = {"stamp": "1", "command": [command["source"], command["sequence"]]}
        image.offer(lambda sequence: Packet("image", sequence, header, b"x"))

    simulator.commands["hand"] = obey
    taker = Taker(server.address, by_hand=True)
    try:
        until(lambda: len(taker.delays) >= 5, "answers come")
    finally:
        taker.close()
    assert len(taker.images) >= 5
    # Each command waits for those before it, so the first is the shortest.
    assert taker.delays[0] >= 1e3 * DELAY_S
    until(lambda: not image.is_watched, "the page has gone")


def test_nobody_there_is_said(served: Any) -> None:
    with pytest.raises(UsSimError, match=r"no viewer answers at http://127\.0\.0\.1:9/"):
        Taker("http://127.0.0.1:9/")
    assert served


def test_what_is_asked_is_compared_with_the_run_without_a_viewer() -> None:
    by_name = {str(case): case for case in cases(quick=True)}
    points = [
        Point(by_name["no viewer, path"], made=60.0),
        Point(by_name["1 page that takes, path"], made=51.0),
        Point(by_name["1 browser, hand"], shown=26.0, delay_median=40.0, delay_p99=130.0),
        Point(by_name["1 page that takes, hand"], failure="it broke", started=1.0),
    ]
    seen = {target.what: (target.seen, target.met) for target in targets(points)}
    assert seen["images a second that the simulator loses to a page that takes"] == ("15 %", False)
    assert seen["images a second in a browser, hand"] == ("26", True)
    assert seen["browser: ms from the mouse to the image, 99th percentile"] == ("130 ms", False)
    assert seen["from `us-sim view` to the first image in a page"] == ("not measured", None)
