"""The settings of strain images.

>>> from us_sim.slicing.strain.settings import Strain
>>> Strain(window="4 mm").window
0.004
>>> Strain(since="yesterday")
Traceback (most recent call last):
...
us_sim.errors.ProbeError: strain.since: 'yesterday' is not one of rest, image
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import ProbeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

_LENGTH = Quantity("length", 0.2e-3, 0.05)


@dataclass(frozen=True)
class Strain(Settings):
    """Strain images: the tissue's own, and an estimate made from two images as a scanner makes it.

    Raises:
        ProbeError: a value is out of range, with its name and the range.
    """

    section = "strain"
    error = ProbeError
    live = True

    since: str = setting(
        default="rest",
        choices=("rest", "image"),
        description="what the tissue's own strain counts from: the tissue at rest, or the image "
        "that the estimate is compared with, too",
    )
    interval: int = setting(
        Quantity("number", 1, 60),
        "images from one to the one it is compared with; a slow press needs several",
        default=2,
    )
    borders: str = setting(
        default="smooth",
        choices=("smooth", "sharp"),
        description="of the tissue's own strain between two labels: averaged like all else, or not "
        "averaged, which is truer near borders, and shows the tetrahedra there",
    )
    colours: float | None = setting(
        Quantity("number", 1e-4, 1.0),
        "strain at the ends of the colour bar; not given: a round value that follows the images",
        default=None,
    )
    window: float = setting(
        _LENGTH,
        "along the beam, of what is found again in the other image; a third of it across",
        default=3e-3,
    )
    search: float = setting(
        Quantity("length", 0.05e-3, 0.02),
        "along the beam, how far it is looked for",
        default=0.6e-3,
    )
    fit: float = setting(
        _LENGTH,
        "along the beam, of the line that is fitted to displacement, whose slope is the strain",
        default=6e-3,
    )
    correlation: float = setting(
        Quantity("number", 0.0, 1.0),
        "of what was found with what was looked for: the least that is used",
        default=0.7,
    )
