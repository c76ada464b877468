"""The settings of an OpenIGTLink server in a scene: its address, and the frame of its poses.

>>> from us_sim.tracking.openigtlink.settings import OpenIGTLinkSettings
>>> OpenIGTLinkSettings(host="tracker.local", world="ras").port
18944
>>> OpenIGTLinkSettings(port=70000)
Traceback (most recent call last):
...
us_sim.errors.TrackingError: openigtlink.port: 70000 is outside 1 to 65535
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import TrackingError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

WORLDS = ("tracker", "lps", "ras")
CLOCKS = ("server", "arrival")


@dataclass(frozen=True)
class OpenIGTLinkSettings(Settings):
    """The settings of the connection; each is a key of a scene's ``tracker.openigtlink:``.

    Which of the server's devices is the probe is the scene's ``tracker.body``.

    Raises:
        TrackingError: a value is out of range.
    """

    section = "openigtlink"
    error = TrackingError

    host: str = setting(default="localhost", description="name or address of the server")
    port: int = setting(Quantity("number", 1, 65535), default=18944, description="TCP port")
    world: str = setting(
        default="tracker",
        choices=WORLDS,
        description="what the poses are in: the tracker's own frame, or an image's LPS or RAS; "
        "RAS, which 3D Slicer sends, is turned into LPS, in which volumes are read",
    )
    clock: str = setting(
        default="server",
        choices=CLOCKS,
        description="server: the messages' own stamps; arrival: when they come, for a server "
        "whose clock is not this computer's",
    )
    tracking_data: bool = setting(
        default=False,
        description="ask for TDATA, for servers that send nothing unasked",
    )
    interval: float = setting(
        Quantity("time", 1e-3, 10.0),
        default=0.01,
        description="time between two TDATA, if asked for",
    )

    def check(self) -> None:
        """A server has a name."""
        if not self.host.strip():
            raise self.refused("host", "is empty: name the server, or localhost")
