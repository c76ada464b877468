"""Colours laid over a grey image, with a bar that says which value has which colour.

>>> import numpy as np
>>> from us_sim.slicing.drawing.overlay import ColourScale, Overlay
>>> blue_to_red = (0, 0, 255), (255, 0, 0)
>>> scale = ColourScale("strain", -0.05, 0.05, "%", factor=100.0, colours=blue_to_red)
>>> grey = np.full((1, 3, 3), 100, np.uint8)
>>> Overlay(np.float32([[-0.05, np.nan, 0.2]]), scale, opacity=1.0).lay_over(grey)
>>> grey.tolist()
[[[0, 0, 255], [100, 100, 100], [255, 0, 0]]]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.drawing.lettering import Colour


@dataclass(frozen=True)
class ColourScale:
    """Which colour a value has: those evenly spaced from ``low`` to ``high``, blended between."""

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

    def levels(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """The row of `table` for each value of an array of any shape; any for NaN."""
        scale = np.float32(255.0 / (self.high - self.low))
        levels = (np.asarray(values, dtype=np.float32) - np.float32(self.low)) * scale
        np.nan_to_num(levels, copy=False)
        return np.asarray(np.rint(np.clip(levels, 0.0, 255.0, out=levels), out=levels), np.uint8)

    def text(self, value: float) -> str:
        """A value as it stands at the bar, without the unit."""
        return f"{self.factor * value:.3g}"


@dataclass(frozen=True, eq=False)
class Overlay:
    """Values over an image, in colours.

    Args:
        values: (rows, columns), NaN where the image is left as it is.
        scale: which colour each has.
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

    def flipped(self) -> Overlay:
        """The same with left and right exchanged."""
        outline = self.outline
        if outline is not None:
            outline = mirrored(outline, self.values.shape[1])
        return replace(self, values=np.ascontiguousarray(self.values[:, ::-1]), outline=outline)

    def lay_over(self, picture: NDArray[np.uint8]) -> None:
        """Blend the colours into a (rows, columns, 3) picture of red, green and blue."""
        levels = cv2.cvtColor(self.scale.levels(self.values), cv2.COLOR_GRAY2RGB)
        colours = cv2.LUT(levels, self.scale.table[None])
        blended = cv2.addWeighted(colours, self.opacity, picture, 1.0 - self.opacity, 0.0)
        there = np.equal(self.values, self.values).view(np.uint8)  # not NaN
        cv2.copyTo(blended, there, picture)


def mirrored(line: NDArray[np.floating], columns: int) -> NDArray[np.floating]:
    """Column and row (N, 2) in an image of so many columns whose left and right are exchanged."""
    return np.column_stack([columns - 1 - line[:, 0], line[:, 1]])
