"""The colours of strain: red where tissue got shorter, grey where not, blue where it got longer.

>>> from us_sim.slicing.strain.colours import strain_scale
>>> strain_scale("strain", 0.05).table[[0, 255]].tolist()
[[215, 48, 39], [69, 117, 180]]
"""

from __future__ import annotations

from us_sim.slicing.drawing.overlay import ColourScale

__all__ = ["strain_scale"]

_COLOURS = ((215, 48, 39), (253, 174, 97), (48, 48, 48), (116, 173, 209), (69, 117, 180))


def strain_scale(name: str, most: float) -> ColourScale:
    """From -most to most, in percent at the bar; red and blue differ to colour-blind eyes, too."""
    title = name.replace("_", " ")
    return ColourScale(title, -most, most, "%", factor=100.0, colours=_COLOURS)
