"""What the terminal says of a run that goes on."""

from types import SimpleNamespace
from typing import Any

import pytest

from us_sim.run.live import _status
from us_sim.run.plan import Plan


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        (Plan([], 40), "waiting for poses"),
        (Plan([], loops=True), "begins again at its end; waiting for poses"),
        (Plan([], 40, loops=True), "begins again every 40 poses; waiting for poses"),
        (
            Plan([], 40, player="camera_driver", loops=True),
            "begins again every 40 images; waiting for poses",
        ),
    ],
)
def test_a_run_says_when_what_it_plays_begins_again(plan: Plan, said: str) -> None:
    node: Any = SimpleNamespace(reports={}, count=lambda *_: 0)
    monitor: Any = SimpleNamespace(node=node)
    assert _status(plan, monitor) == said
