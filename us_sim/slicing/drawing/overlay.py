"""Colours laid over a grey image, their bar, and small legible text.

>>> import numpy as np
>>> from us_sim.slicing.drawing.overlay import ColourScale, Overlay
>>> blue_to_red = (0, 0, 255), (255, 0, 0)
>>> scale = ColourScale("strain", -0.05, 0.05, "%", factor=100.0, colours=blue_to_red)
>>> grey = np.full((1, 3, 3), 100, np.uint8)
>>> Overlay(np.float32([[-0.05, np.nan, 0.2]]), scale, opacity=1.0).blend_into(grey)
>>> grey.tolist()
[[[0, 0, 255], [100, 100, 100], [255, 0, 0]]]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Colour = tuple[int, int, int]  # red, green and blue, 0 to 255
_FINER = 4  # letters are drawn this much larger and averaged, as OpenCV's own small ones are ragged
_CAPITAL = 21  # height of a capital letter of OpenCV's font at scale 1, px, without its strokes
_HALO = 2  # width of the halo around letters, px


@dataclass(frozen=True, eq=False)
class TextPatch:
    """Text as a patch to be blended into a picture."""

    colours: NDArray[np.uint8]  # (height, width, 3)
    opacity: NDArray[np.float32]  # (height, width), 0 to 1

    @property
    def height(self) -> int:
        """Height, px."""
        return self.opacity.shape[0]

    @property
    def width(self) -> int:
        """Width, px."""
        return self.opacity.shape[1]

    def draw_at(self, picture: NDArray[np.uint8], column: int, row: int) -> bool:
        """Blend the text into a (rows, columns, 3) picture with its upper left corner there.

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
def render_text(text: str, height: int, colour: Colour) -> TextPatch:
    """Render ``text`` with capital letters about ``height`` px high."""
    large = _FINER * height
    letters = _cropped(text, large, _scale(large))
    rows, columns = (-(-side // _FINER) for side in letters.shape)
    whole = np.zeros((rows * _FINER, columns * _FINER), np.uint8)
    whole[: letters.shape[0], : letters.shape[1]] = letters
    averaged = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    padded = np.pad(averaged.astype(np.float32) / np.float32(255), _HALO)
    halo = cv2.GaussianBlur(cv2.dilate(padded, np.ones((3, 3), np.uint8)), (3, 3), 0.0)
    opacity = np.maximum(padded, 0.8 * halo)
    share = np.divide(padded, opacity, out=np.zeros_like(padded), where=opacity > 0)
    colours = np.rint(share[:, :, None] * np.array(colour, np.float32)).astype(np.uint8)
    return TextPatch(colours, opacity)


@lru_cache(maxsize=64)
def _scale(large: int) -> float:
    """Return the font's scale for capitals ``large`` px high, with the strokes OpenCV may add."""
    first = large / _CAPITAL
    return first * large / _cropped("H", large, first).shape[0]


def _cropped(text: str, large: int, scale: float) -> NDArray[np.uint8]:
    canvas = np.zeros((3 * large, 2 * large * (len(text) + 1)), np.uint8)
    stroke = max(1, round(large / 7))
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(canvas, text, (large, 2 * large), font, scale, (255,), stroke, cv2.LINE_AA)
    left, top, width, height = cv2.boundingRect(canvas)
    return canvas[top : top + max(1, height), left : left + max(1, width)]


@dataclass(frozen=True)
class ColourScale:
    """Colours of values: evenly spaced from ``low`` to ``high``, blended between."""

    title: str
    low: float
    high: float
    unit: str  # as the bar says it
    factor: float = 1.0  # by which the array's values become those in that unit
    colours: Sequence[Colour] = ((0, 0, 255), (255, 255, 255), (255, 0, 0))

    @cached_property
    def table(self) -> NDArray[np.uint8]:
        """(256, 3) red, green and blue from ``low`` to ``high``."""
        places = np.linspace(0.0, len(self.colours) - 1.0, 256)
        channels = np.array(self.colours, dtype=np.float64).T
        rows = [np.interp(places, np.arange(len(self.colours)), channel) for channel in channels]
        return np.rint(np.stack(rows, axis=1)).astype(np.uint8)

    def find_levels(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Find the row of `table` for each value of an array of any shape; any for NaN."""
        scale = np.float32(255.0 / (self.high - self.low))
        levels = (np.asarray(values, dtype=np.float32) - np.float32(self.low)) * scale
        np.nan_to_num(levels, copy=False)
        return np.asarray(np.rint(np.clip(levels, 0.0, 255.0, out=levels), out=levels), np.uint8)


@dataclass(frozen=True, eq=False)
class Overlay:
    """Values over an image, in colours.

    Args:
        values: (rows, columns), NaN where the image is left as it is.
        opacity: of the colours over the grey, 0 to 1.
        note: a line of text below the bar; empty for none.
        outline: corners (N, 2) column and row of a closed line around where values are wanted; None
            for none.
    """

    values: NDArray[np.floating]
    scale: ColourScale
    opacity: float = 0.5
    note: str = ""
    outline: NDArray[np.floating] | None = None

    def flip_horizontally(self) -> Overlay:
        """Return the overlay with left and right exchanged."""
        outline = self.outline
        if outline is not None:
            outline = mirror_line(outline, self.values.shape[1])
        return replace(self, values=np.ascontiguousarray(self.values[:, ::-1]), outline=outline)

    def blend_into(self, picture: NDArray[np.uint8]) -> None:
        """Blend the colours into a (rows, columns, 3) picture of red, green and blue."""
        levels = cv2.cvtColor(self.scale.find_levels(self.values), cv2.COLOR_GRAY2RGB)
        colours = cv2.LUT(levels, self.scale.table[None])
        blended = cv2.addWeighted(colours, self.opacity, picture, 1.0 - self.opacity, 0.0)
        there = np.equal(self.values, self.values).view(np.uint8)  # not NaN
        cv2.copyTo(blended, there, picture)


def mirror_line(line: NDArray[np.floating], columns: int) -> NDArray[np.floating]:
    """Mirror column and row (N, 2) in an image of so many columns."""
    return np.column_stack([columns - 1 - line[:, 0], line[:, 1]])


_TEXT: Colour = (205, 215, 215)
_HEIGHT = 9  # of the bar, in heights of a letter


class ColourBar:
    """Drawn over a picture, as far as that has room.

    Args:
        text: px, height of its letters.
        note: a line below it; empty for none.
    """

    def __init__(self, scale: ColourScale, text: int, note: str = "") -> None:
        margin, width, height = text, text, _HEIGHT * text
        title = render_text(f"{scale.title} {scale.unit}".strip(), text, _TEXT)
        values = [
            render_text(f"{scale.factor * value:.3g}", text, _TEXT)
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
            written = render_text(note, text, _TEXT)
            self._labels.append((written, margin, bottom))
            bottom += written.height
        right = max(column + label.width for label, column, _ in self._labels)
        #: Left, top, right and bottom of all of it, px.
        self.box = margin, margin, right, bottom
        levels = np.linspace(255.0, 0.0, height).round().astype(np.intp)
        self._colours = np.repeat(scale.table[levels][:, None], width, axis=1)
        self._corner = margin, top

    def draw(self, picture: NDArray[np.uint8]) -> None:
        """Draw the bar over a (rows, columns, 3) picture."""
        column, row = self._corner
        height, width = self._colours.shape[:2]
        rows, columns = picture.shape[:2]
        if row + height < rows and column + width < columns:
            picture[row : row + height, column : column + width] = self._colours
            corners = (column - 1, row - 1), (column + width, row + height)
            cv2.rectangle(picture, *corners, _TEXT, 1)
        for label, left, top in self._labels:
            label.draw_at(picture, left, top)
