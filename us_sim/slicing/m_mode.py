"""M-mode: the echoes along one beam over time, and pictures whose columns are moments."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.drawing.overlay import Colour, render_text
from us_sim.slicing.probe.beams import convert_to_pixels
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import MModeSettings

_SCALE: Colour = (205, 215, 215)
_LINE: Colour = (90, 100, 100)
_TEXT = 11  # px, height of letters
_BESIDE, _BELOW = 64, 24  # px, room for the scales
_MOST = 6  # numbers along a scale
_ROUNDING = 1e-6  # of a column's duration


class SweepPicture:
    """Grey columns with an axis of time below and another scale on the right.

    Args:
        rows, columns: px, without the scales.
        sweep: s, from the first to the last column.
        scale: what the top and the bottom row stand for, and the unit.
    """

    def __init__(
        self, rows: int, columns: int, sweep: float, scale: tuple[float, float, str]
    ) -> None:
        #: Properties that pictures share whose columns can stand side by side.
        self.layout = rows, columns, sweep, scale
        #: (rows, columns) without the scales; the newest column is the last.
        self.grey = np.zeros((rows, columns), np.uint8)
        self._duration = sweep / columns
        self._last: int | None = None
        top, bottom, unit = scale
        self._frame = np.zeros((rows + _BELOW, columns + _BESIDE, 3), np.uint8)
        cv2.line(self._frame, (columns, 0), (columns, rows), _LINE, 1)
        cv2.line(self._frame, (0, rows), (columns, rows), _LINE, 1)
        self._marks: list[int] = []
        for value in _choose_tick_values(min(top, bottom), max(top, bottom)):
            row = round((value - top) / (bottom - top) * rows - 0.5)
            text = f"{value:g} {unit}" if value == 0 else f"{value:g}"
            label = render_text(text, _TEXT, _SCALE)
            place = int(np.clip(row - label.height // 2, 0, rows - label.height))
            cv2.line(self._frame, (columns, row), (columns + 4, row), _SCALE, 1)
            label.draw_at(self._frame, columns + 7, place)
            self._marks += [row] if value == 0.0 and 0 < row < rows - 1 else []
        for value in _choose_tick_values(-sweep, 0.0):
            column = columns - 1 + round(value / self._duration)
            label = render_text(f"{value:g} s" if value == 0 else f"{value:g}", _TEXT, _SCALE)
            cv2.line(self._frame, (column, rows), (column, rows + 4), _SCALE, 1)
            label.draw_at(self._frame, max(0, column - label.width // 2), rows + 6)

    def advance_to(self, time: float) -> NDArray[np.float64]:
        """Advance to ``time``; return the times (K,) s of the columns to be added.

        After time went back, or stood still for longer than the picture, it begins anew.
        """
        newest = math.floor(time / self._duration + _ROUNDING)
        columns = self.grey.shape[1]
        if self._last is None or not self._last <= newest < self._last + columns:
            self.grey[:] = 0
            self._last = newest - 1
        numbers = np.arange(self._last + 1, newest + 1)
        self._last = newest
        return np.asarray(numbers * self._duration, dtype=np.float64)

    def append_columns(self, columns: NDArray[np.uint8]) -> None:
        """Move the picture to the left and put these columns (rows, K) on its right."""
        count = columns.shape[1]
        if count:
            self.grey[:, :-count] = self.grey[:, count:]
            self.grey[:, -count:] = columns

    def draw_picture(self) -> NDArray[np.uint8]:
        """Draw a new picture of red, green and blue, with its scales."""
        rows, columns = self.grey.shape
        picture = self._frame.copy()
        picture[:rows, :columns] = self.grey[:, :, None]
        for row in self._marks:
            picture[row, :columns] = np.maximum(picture[row, :columns], np.uint8(90))
        return picture


def _choose_tick_values(low: float, high: float) -> list[float]:
    """Return a few multiples of 1, 2 or 5 times a power of ten in a range, ends included."""
    rough = (high - low) / _MOST
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(step for step in (power, 2 * power, 5 * power, 10 * power) if step >= rough)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 12) + 0.0 for number in range(first, last + 1)]


_ROWS, _COLUMNS = 384, 512


class MMode:
    """The echoes along a line of one probe's images."""

    def __init__(self, probe: Probe, settings: MModeSettings) -> None:
        self.settings = settings
        depth = (np.arange(_ROWS) + 0.5) * (probe.depth / _ROWS)
        places = convert_to_pixels(probe, np.full(_ROWS, settings.lateral), depth)
        #: (2, 2) column and row of the ends of the line.
        self.places = places[[0, -1]]
        column, row = places.astype(np.float32).T
        self._column, self._row = column.copy()[:, None], row.copy()[:, None]
        self._picture = SweepPicture(
            _ROWS, _COLUMNS, settings.sweep, (0.0, 1e3 * probe.depth, "mm")
        )

    def take_over_picture(self, before: MMode) -> None:
        """Continue the picture of another line, if its scales are the same."""
        if before._picture.layout == self._picture.layout:
            self._picture = before._picture

    def sample_line(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Sample grey values (rows,) along the line of an image (rows, columns), from the top."""
        linear, edge = cv2.INTER_LINEAR, cv2.BORDER_REPLICATE
        line = cv2.remap(image, self._column, self._row, linear, borderMode=edge)
        return np.asarray(line, dtype=np.uint8)[:, 0]

    def draw_sweep(self, image: NDArray[np.uint8], time: float) -> NDArray[np.uint8]:
        """Draw the picture (rows, columns, 3) up to the image at a time (s), with its scales.

        Between two images it shows the later one.
        """
        count = len(self._picture.advance_to(time))
        self._picture.append_columns(np.repeat(self.sample_line(image)[:, None], count, axis=1))
        return self._picture.draw_picture()
