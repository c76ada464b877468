"""Small text on a picture: bright letters in a dark halo, legible on any grey.

>>> import numpy as np
>>> from us_sim.slicing.drawing.lettering import lettering
>>> picture = np.zeros((40, 80, 3), np.uint8)
>>> label = lettering("10 mm", 12, (255, 255, 255))
>>> label.draw(picture, 5, 8)
True
>>> bool(picture.any()), label.draw(picture, 75, 8)  # it does not fit there, and is left out
(True, False)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Colour = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

_FINER = 4
"""Letters are drawn this much larger and averaged, as OpenCV's own small ones are ragged."""

_CAPITAL = 21
"""Height of a capital letter of OpenCV's font at scale 1, px, without its strokes."""

_HALO = 2
"""Width of the halo around letters, px."""


@dataclass(frozen=True, eq=False)
class Label:
    """Text as a patch to be blended into a picture."""

    colours: NDArray[np.uint8]  # (height, width, 3)
    opacity: NDArray[np.float32]  # (height, width), 0 to 1

    @property
    def height(self) -> int:
        """px."""
        return self.opacity.shape[0]

    @property
    def width(self) -> int:
        """px."""
        return self.opacity.shape[1]

    def draw(self, picture: NDArray[np.uint8], column: int, row: int) -> bool:
        """Blend it into a (rows, columns, 3) picture with its upper left corner there.

        Returns:
            False where it would not be inside the picture; then nothing is drawn.
        """
        rows, columns = picture.shape[:2]
        if not (0 <= row <= rows - self.height and 0 <= column <= columns - self.width):
            return False
        place = picture[row : row + self.height, column : column + self.width]
        place[:] = cv2.blendLinear(place, self.colours, 1.0 - self.opacity, self.opacity)
        return True


@lru_cache(maxsize=64)
def lettering(text: str, height: int, colour: Colour) -> Label:
    """``text`` with capital letters about ``height`` px high."""
    letters = _letters(text, height)
    padded = np.pad(letters, _HALO)
    halo = cv2.GaussianBlur(cv2.dilate(padded, np.ones((3, 3), np.uint8)), (3, 3), 0.0)
    opacity = np.maximum(padded, 0.8 * halo)
    letters = np.divide(padded, opacity, out=np.zeros_like(padded), where=opacity > 0)
    colours = np.rint(letters[:, :, None] * np.array(colour, np.float32)).astype(np.uint8)
    return Label(colours, opacity)


def _letters(text: str, height: int) -> NDArray[np.float32]:
    """The fraction of each pixel that the letters cover, cropped to them."""
    large = _FINER * height
    letters = _cropped(text, large, _scale(large))
    rows, columns = (-(-side // _FINER) for side in letters.shape)
    whole = np.zeros((rows * _FINER, columns * _FINER), np.uint8)
    whole[: letters.shape[0], : letters.shape[1]] = letters
    averaged = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    return averaged.astype(np.float32) / np.float32(255)


@lru_cache(maxsize=64)
def _scale(large: int) -> float:
    """The scale at which capitals are that high; strokes add to it in some versions of OpenCV."""
    first = large / _CAPITAL
    return first * large / _cropped("H", large, first).shape[0]


def _cropped(text: str, large: int, scale: float) -> NDArray[np.uint8]:
    """White on black, in letters about ``large`` px high."""
    canvas = np.zeros((3 * large, 2 * large * (len(text) + 1)), np.uint8)
    stroke = max(1, round(large / 7))
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(canvas, text, (large, 2 * large), font, scale, (255,), stroke, cv2.LINE_AA)
    left, top, width, height = cv2.boundingRect(canvas)
    return canvas[top : top + max(1, height), left : left + max(1, width)]
