"""Settings of the viewer, which the command line reads without ROS."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

TOKEN = "US_SIM_VIEWER_TOKEN"
"""In the environment: what an address must hold that is not this computer's own. Other users of the
computer cannot read it there, as they could on a command line or among ROS parameters."""


@dataclass(frozen=True)
class ViewerSettings(Settings):
    """Of ``viewer``."""

    host: str = setting(
        description="address to listen at; any but this computer's own needs the token that is "
        "printed with the address",
        default="127.0.0.1",
    )
    port: int = setting(
        Quantity("number", 0, 65535), "TCP port; 0 is any that is free", default=8080
    )
    rate: float = setting(
        Quantity("frequency", 1.0, 120.0), "images and meshes, at most, for each page", default=30.0
    )
    recordings: str | None = setting(
        description="folder to which pages record; not given: the one that us-sim runs in. Pages "
        "that other computers may open record nowhere else",
        default=None,
    )
