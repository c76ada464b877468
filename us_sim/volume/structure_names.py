"""Names of structures, which must not say whose they are, and their colours.

A segmentation's names are free text, and some hold a patient's. Of those that come from a file only
names made of known words are kept.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from functools import cache

from us_sim.share import shared_path
from us_sim.tissue.elasticity.material import guess_tissue_kind

AROUND = "tissue"  # name of what is in no structure: label 0, or all of a volume without labels
_PHRASES = re.compile(r"\b(?:gr[ae]y|white) (?=matter\b)")

_NUMERAL = re.compile(r"\d{1,2}|[ivx]{1,4}[ab]?|[a-d]|[lctsr]\d{1,2}")


def is_anatomical(name: str) -> bool:
    """Tell whether a name is of words of anatomy, sides and numbers to two digits alone."""
    words = _PHRASES.sub("", make_readable(name).lower()).split()
    others = [word for word in words if word not in _words()]
    return len(others) < len(words) <= 8 and all(map(_NUMERAL.fullmatch, others))


@cache
def _words() -> frozenset[str]:
    """Read English and Latin words of anatomy, of its sides, and of what is found in a body.

    They are those of 3D Slicer's and TotalSegmentator's names, and of muscles, bones and vessels
    of the limbs. Words that are many people's names stand in `_PHRASES` with what goes with them.
    """
    return frozenset(shared_path("config/anatomy.txt").read_text(encoding="utf-8").split())


def make_readable(name: str) -> str:
    """Put blanks in place of the underscores, dots and hyphens that programs write."""
    return " ".join(re.sub(r"[_\-.,]+", " ", name).split())


Colour = tuple[float, float, float]  # red, green and blue, 0 to 1

_COLOURS: dict[str, Colour] = {
    "artery": (0.85, 0.15, 0.15),
    "vein": (0.25, 0.4, 0.85),
    "thrombus": (0.5, 0.3, 0.8),
    "bone": (0.93, 0.9, 0.8),
    "nerve": (0.95, 0.85, 0.3),
    "fat": (0.95, 0.85, 0.6),
    "muscle": (0.75, 0.35, 0.3),
    "skin": (0.85, 0.7, 0.6),
    "liver": (0.6, 0.3, 0.2),
    "kidney": (0.7, 0.4, 0.3),
    "fluid": (0.4, 0.6, 0.3),
}
"""By the kinds of tissue that names are of."""
_ANY_OTHER: Colour = (0.7, 0.6, 0.55)


def choose_colour(name: str) -> Colour:
    """Return red, green and blue of a structure, by the kind of tissue that its name says."""
    return _COLOURS.get(guess_tissue_kind(name), _ANY_OTHER)


_SHADES = (0.0, 0.45, 0.25, 0.65)  # part of white in the first, second, ... of one colour


def choose_colours(names: Iterable[str]) -> dict[str, Colour]:
    """Return colours of structures by name; what has the same `choose_colour` gets shades.

    >>> choose_colours(["portal vein", "hepatic vein", "liver"])["hepatic vein"]
    (0.588, 0.67, 0.917)
    """
    seen: Counter[Colour] = Counter()
    colours = {}
    for name in names:
        colour = choose_colour(name)
        white = _SHADES[seen[colour] % len(_SHADES)]
        seen[colour] += 1
        red, green, blue = (round(part + white * (1.0 - part), 3) for part in colour)
        colours[name] = (red, green, blue)
    return colours
