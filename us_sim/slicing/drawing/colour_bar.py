"""A bar of colours at the upper left of a picture, with what it shows, its values and their unit.

>>> import numpy as np
>>> from us_sim.slicing.drawing.colour_bar import ColourBar
>>> from us_sim.slicing.drawing.overlay import ColourScale
>>> bar = ColourBar(ColourScale("velocity", -0.2, 0.2, "cm/s", factor=100.0), 10)
>>> picture = np.zeros((200, 120, 3), np.uint8)
>>> bar.draw(picture)
>>> left, top, right, bottom = bar.box
>>> bool(picture[top:bottom, left:right].any()), bool(picture[:, right:].any())
(True, False)
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.drawing.lettering import Colour, lettering
from us_sim.slicing.drawing.overlay import ColourScale

_TEXT: Colour = (205, 215, 215)
_HEIGHT = 9
"""Of the bar, in heights of a letter."""


class ColourBar:
    """Drawn over a picture, as far as that has room.

    Args:
        scale: which colour each value has.
        text: px, height of its letters.
        note: a line below it; empty for none.
    """

    def __init__(self, scale: ColourScale, text: int, note: str = "") -> None:
        margin, width, height = text, text, _HEIGHT * text
        title = lettering(f"{scale.title} {scale.unit}".strip(), text, _TEXT)
        values = [
            lettering(scale.text(value), text, _TEXT)
            for value in (scale.high, 0.5 * (scale.low + scale.high), scale.low)
        ]
        top = margin + title.height + text // 2
        beside = margin + width + text // 3
        self._labels = [(title, margin, margin)] + [
            (value, beside, top + round(part * height) - value.height // 2)
            for value, part in zip(values, (0.0, 0.5, 1.0), strict=True)
        ]
        bottom = top + height + text
        if note:
            written = lettering(note, text, _TEXT)
            self._labels.append((written, margin, bottom))
            bottom += written.height
        right = max(column + label.width for label, column, _ in self._labels)
        #: Left, top, right and bottom of all of it, px.
        self.box = margin, margin, right, bottom
        levels = np.linspace(255.0, 0.0, height).round().astype(np.intp)
        self._colours = np.repeat(scale.table[levels][:, None], width, axis=1)
        self._corner = margin, top

    def draw(self, picture: NDArray[np.uint8]) -> None:
        """Draw it over a (rows, columns, 3) picture."""
        column, row = self._corner
        height, width = self._colours.shape[:2]
        rows, columns = picture.shape[:2]
        if row + height < rows and column + width < columns:
            picture[row : row + height, column : column + width] = self._colours
            corners = (column - 1, row - 1), (column + width, row + height)
            cv2.rectangle(picture, *corners, _TEXT, 1)
        for label, left, top in self._labels:
            label.draw(picture, left, top)
