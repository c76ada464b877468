"""What a scene or a case says of a transducer: its array, its image, and the shape that presses.

>>> from us_sim.geometry.transducer import ProbeSettings
>>> from us_sim.settings.reading import Reader
>>> given = {"aperture": "40 mm", "depth": "30 mm", "image": [400, 300]}
>>> probe = Reader("my.yaml").read(ProbeSettings, given, "probe")
>>> probe.geometry, probe.image
('linear', (400, 300))
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import SceneError
from us_sim.settings.choice import Chosen
from us_sim.settings.quantity import Quantity
from us_sim.settings.registry import COLLIDERS, PROBES
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class ProbeSettings(Settings):
    """The transducer: its geometry, the image it makes, and the shape that presses."""

    section = "probe"
    error = SceneError

    array: Chosen = setting(
        description="kind of transducer",
        choice=PROBES,
        place="beside",
        default=Chosen("linear"),
    )
    image: tuple[int, int] | int | None = setting(
        Quantity("number", 1, 4096),
        "[columns, rows], or the number of rows of square pixels; not given: [512, 512] of a "
        "linear array, else 512",
        default=None,
    )
    collider: Chosen | None = setting(
        description="shape that presses", choice=COLLIDERS, default=None
    )

    @property
    def geometry(self) -> str:
        """The kind of transducer."""
        return self.array.name
