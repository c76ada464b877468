"""The colours of strain: red where tissue got shorter, grey where not, blue where it got longer.

>>> from us_sim.slicing.strain.colours import strain_scale
>>> strain_scale("strain", 0.05).table[[0, 255]].tolist()
[[215, 48, 39], [69, 117, 180]]

The ends of the bar may follow the images, as far as they must:

>>> import numpy as np
>>> from us_sim.slicing.strain.colours import FollowingEnd
>>> end = FollowingEnd()
>>> [end.of(np.full((8, 8), strain)) for strain in (-0.14, -0.19, -0.24, -0.13, -0.04)]
[0.2, 0.2, 0.3, 0.3, 0.05]
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.drawing.overlay import ColourScale

_COLOURS = ((215, 48, 39), (253, 174, 97), (48, 48, 48), (116, 173, 209), (69, 117, 180))

_ENDS = tuple(step / power for power in (100, 10, 1) for step in (1, 2, 3, 5))
"""Round values at which a bar may end; strain beyond the last has its colour."""
_HELD = 95.0  # percent of the pixels that lie within the bar; a vein that collapses need not
_STAYS = 0.4  # the bar's end stays until strain is less than this much of it
_STEP = 4  # pixels from one that is looked at to the next


class FollowingEnd:
    """The strain at the ends of a bar that holds nearly all of an image, and seldom changes."""

    def __init__(self) -> None:
        self._end = 0.0

    def of(self, values: NDArray[np.floating]) -> float:
        """The end for an image (rows, columns), NaN where there is no strain."""
        sizes = np.abs(values[::_STEP, ::_STEP])
        sizes = sizes[np.isfinite(sizes)]
        most = float(np.percentile(sizes, _HELD)) if sizes.size else 0.0
        if not _STAYS * self._end < most <= self._end:
            self._end = next((end for end in _ENDS if most <= end), _ENDS[-1])
        return self._end


def strain_scale(name: str, most: float) -> ColourScale:
    """From -most to most, in percent at the bar; red and blue differ to colour-blind eyes, too."""
    title = name.replace("_", " ")
    return ColourScale(title, -most, most, "%", factor=100.0, colours=_COLOURS)
