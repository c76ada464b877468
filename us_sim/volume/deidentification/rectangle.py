"""A rectangle of pixels, as DICOM gives the regions of an ultrasound image: its last ones belong
to it.

>>> from us_sim.volume.deidentification.rectangle import Rectangle
>>> Rectangle.read("10,20,109,219").size
(100, 200)
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError


@dataclass(frozen=True)
class Rectangle:
    """From a first column and row to last ones."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def read(cls, text: str) -> Rectangle:
        """From ``X0,Y0,X1,Y1``.

        Raises:
            VolumeError: it is written otherwise, or holds no pixel.
        """
        words = [word.strip() for word in text.split(",")]
        if len(words) != 4 or not all(re.fullmatch(r"[0-9]{1,5}", word) for word in words):
            raise VolumeError(
                f"crop: {text[:80]!r} is no rectangle; write X0,Y0,X1,Y1: its first column and row "
                f"and its last ones, counted from 0"
            )
        made = cls(*map(int, words))
        if min(made.size) < 1:
            raise VolumeError(f"crop: {text[:80]!r} holds no pixel: X1 and Y1 are the last ones")
        return made

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.right - self.left + 1, self.bottom - self.top + 1

    @property
    def slices(self) -> tuple[slice, slice]:
        """Of (rows, columns)."""
        return slice(self.top, self.bottom + 1), slice(self.left, self.right + 1)

    def grown(self, margin: int) -> Rectangle:
        """With so many more pixels on every side; none before the first column and row."""
        return Rectangle(
            max(self.left - margin, 0),
            max(self.top - margin, 0),
            self.right + margin,
            self.bottom + margin,
        )

    def __str__(self) -> str:
        return f"{self.left},{self.top},{self.right},{self.bottom}"

    def mask(self, rows: int, columns: int) -> NDArray[np.bool_]:
        """(rows, columns) true within."""
        made = np.zeros((rows, columns), bool)
        made[self.slices] = True
        return made
