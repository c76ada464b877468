"""Which part of images to keep, proposed to a person: where the echoes seem to be.

>>> import numpy as np
>>> from us_sim.volume.deidentification.proposal import proposed_part
>>> image = np.zeros((100, 200), np.uint8)
>>> image[30:90, 50:150] = np.random.default_rng(1).integers(10, 200, (60, 100))
>>> print(proposed_part([image], []))
50,30,149,89
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.volume.deidentification.rectangle import Rectangle

_MOVES = 16  # grey levels between images
_SHINES = 8  # grey levels above black
_CLOSE = 15  # px, gaps that are bridged


def proposed_part(
    images: Sequence[NDArray[np.uint8]], text: Sequence[Rectangle]
) -> Rectangle | None:
    """The largest connected part that moves, or of one image that is not black; no text.

    Args:
        images: (rows, columns) of equal size.
        text: what may be text.
    """
    stack = np.stack(images)
    moving = np.ptp(stack, axis=0) > _MOVES
    seen = moving if moving.mean() > 0.01 else stack.max(axis=0) > _SHINES
    seen = seen.astype(np.uint8)
    for line in text:
        seen[line.slices] = 0
    opened = cv2.morphologyEx(seen, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((_CLOSE, _CLOSE), np.uint8))
    count, _, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    if count < 2:
        return None
    left, top, width, height, _ = (
        int(each) for each in stats[1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))]
    )
    return Rectangle(left, top, left + width - 1, top + height - 1)
