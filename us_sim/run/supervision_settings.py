"""What is done for a node that has ended or hangs, as options of `us-sim` say it."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class SupervisionSettings(Settings):
    """What is done for a node that has ended or hangs."""

    restarts: int = setting(
        Quantity("number", 0, 1_000_000),
        "start a node that ended or hangs again, at most so often",
        default=10,
    )
    restarts_per_minute: int = setting(
        Quantity("number", 1, 1_000_000), "and at most so often in a minute", default=3
    )
    silence: float = setting(
        Quantity("time", 2.0, 3600.0),
        "without a report after which a node hangs; six times as long while it works",
        default=10.0,
    )
    standby: bool = setting(
        description="keep a second process of each node that takes long to start, which takes over "
        "at once; needs twice the memory",
        default=False,
    )
