"""Colours of structures by their names, as anatomical atlases paint them.

>>> from us_sim.volume.anatomical_colours import anatomical_colour
>>> anatomical_colour("hepatic vein")  # blue
(0.25, 0.4, 0.85)
"""

from __future__ import annotations

import re

Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

_COLOURS: dict[str, Colour] = {
    "artery": (0.85, 0.15, 0.15),
    "aorta": (0.85, 0.15, 0.15),
    "vein": (0.25, 0.4, 0.85),
    "cava": (0.25, 0.4, 0.85),
    "portal": (0.25, 0.4, 0.85),
    "vessel": (0.5, 0.3, 0.8),
    "vessels": (0.5, 0.3, 0.8),
    "bone": (0.93, 0.9, 0.8),
    "rib": (0.93, 0.9, 0.8),
    "nerve": (0.95, 0.85, 0.3),
    "fat": (0.95, 0.85, 0.6),
    "muscle": (0.75, 0.35, 0.3),
    "skin": (0.85, 0.7, 0.6),
    "liver": (0.6, 0.3, 0.2),
    "kidney": (0.7, 0.4, 0.3),
    "gallbladder": (0.4, 0.6, 0.3),
    "diaphragm": (0.7, 0.5, 0.5),
}
_ANY_OTHER: Colour = (0.7, 0.6, 0.55)


def anatomical_colour(name: str) -> Colour:
    """Red, green and blue for a structure; of several known words in its name the last one."""
    words = [word for word in re.split(r"[^a-z]+", name.lower()) if word in _COLOURS]
    return _COLOURS[words[-1]] if words else _ANY_OTHER
