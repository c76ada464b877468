"""How ultrasound images lie in a file: Plus' orientation codes, and turning images to ``MF``.

A code's first letter says where columns go as they are counted up, its second where rows go: to
the probe's marked (M) or unmarked side (U), far from it (F) or near (N). A third letter says how
slices follow in a volume (A ascending, D descending) and means nothing for a flat image. The
transforms of a sequence hold for images in ``MF``, to which Plus turns them as it reads them
(plustoolkit.org, "Ultrasound image orientation").

>>> import numpy as np
>>> from us_sim.volume.sequences.orientation import turned
>>> turned(np.array([[1, 2], [3, 4], [5, 6]]), "UN")
array([[6, 5],
       [4, 3],
       [2, 1]])
>>> turned(np.array([[1, 2], [3, 4], [5, 6]]), "FM")
array([[1, 3, 5],
       [2, 4, 6]])
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

_CODE = re.compile(r"([UM][FN]|[FN][UM])[AD]?")


def is_orientation(code: str) -> bool:
    """Whether a code says how flat images lie."""
    return _CODE.fullmatch(code) is not None


def is_transposed(code: str) -> bool:
    """Whether the image's columns go along the depth."""
    return code[0] in "FN"


def turned(image: NDArray[np.uint8], code: str) -> NDArray[np.uint8]:
    """A view of an image (rows, columns) that was stored in an orientation, as it is in ``MF``."""
    across, down = code[0], code[1]
    if is_transposed(code):
        image, across, down = image.T, down, across
    if across == "U":
        image = image[:, ::-1]
    return image[::-1] if down == "N" else image
