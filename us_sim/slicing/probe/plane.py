"""The plane of pixels on which an image is cut, in frame ``patient``."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError

_MOST_PIXELS = 4096


@dataclass(frozen=True, eq=False)
class SlicePlane:
    """A grid of pixel centres: ``origin + column * column_step + row * row_step``.

    Every probe's image is such a grid, whatever its beams.

    Args:
        spans: for an image that does not fill its grid, as a fan: up to two half-open runs of
            columns of each row that show something; the rest is black.

    Raises:
        ProbeError: a number is not finite, the two steps are parallel or zero, the grid has no
            pixel or more than 4096 a side, or spans that are not within it.
    """

    origin: NDArray[np.float64]  # (3,) m, centre of the pixel in row 0 and column 0
    column_step: NDArray[np.float64]  # (3,) m, from one column to the next
    row_step: NDArray[np.float64]  # (3,) m, from one row to the next
    columns: int
    rows: int
    spans: NDArray[np.int32] | None = None  # (rows, 2, 2): first and end column of two runs

    def __post_init__(self) -> None:
        for name in ("origin", "column_step", "row_step"):
            vector = np.array(getattr(self, name), dtype=np.float64)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise ProbeError(f"the plane's {name} is not three finite coordinates: {vector}")
            vector.flags.writeable = False
            object.__setattr__(self, name, vector)
        require_pixel_counts(self.columns, self.rows)
        if self.spans is not None:
            object.__setattr__(self, "spans", _runs_within(self.spans, self.rows, self.columns))
        area = np.linalg.norm(self._normal)
        scale = np.linalg.norm(self.column_step) * np.linalg.norm(self.row_step)
        if not area > 1e-6 * scale:
            raise ProbeError(
                f"the plane's column_step {self.column_step.tolist()} and row_step "
                f"{self.row_step.tolist()} do not span a plane: give two directions"
            )

    @cached_property
    def basis(self) -> NDArray[np.float64]:
        """(3, 3) m: column_step, row_step and a normal about as long as a pixel, as columns."""
        normal = self._normal / np.sqrt(np.linalg.norm(self._normal))
        return np.column_stack([self.column_step, self.row_step, normal])

    @cached_property
    def _normal(self) -> NDArray[np.float64]:  # m², as long as a pixel is large
        return np.cross(self.column_step, self.row_step)

    @cached_property
    def to_pixel(self) -> NDArray[np.float64]:
        """(3, 4) affine map from a position (m) to column, row and height above the plane."""
        inverse = np.linalg.inv(self.basis)
        return np.ascontiguousarray(np.column_stack([inverse, -inverse @ self.origin]))

    def make_shown_mask(self) -> NDArray[np.bool_]:
        """Return (rows, columns): True for pixels that show something."""
        if self.spans is None:
            return np.ones((self.rows, self.columns), dtype=np.bool_)
        column = np.arange(self.columns)[None, :]
        first, end = self.spans[:, :, 0, None], self.spans[:, :, 1, None]
        return np.asarray(((column[:, None] >= first) & (column[:, None] < end)).any(axis=1))

    def compute_pixel_positions(self) -> NDArray[np.float64]:
        """Compute (rows, columns, 3) m: the position of every pixel centre."""
        column = np.arange(self.columns)[None, :, None]
        row = np.arange(self.rows)[:, None, None]
        return self.origin + column * self.column_step + row * self.row_step


def _runs_within(spans: NDArray[np.int32], rows: int, columns: int) -> NDArray[np.int32]:
    """Return the spans as kernels take them, once they are known to lie within the image."""
    runs = np.ascontiguousarray(spans, dtype=np.int32)
    if runs.shape != (rows, 2, 2) or runs.min() < 0 or runs.max() > columns:
        raise ProbeError(
            f"the plane's spans have shape {runs.shape} and run from {runs.min(initial=0)} to "
            f"{runs.max(initial=0)}: give two runs of columns, 0 to {columns}, of each of the "
            f"{rows} rows"
        )
    runs = runs.view()
    runs.flags.writeable = False  # as a probe's own are, or numba would compile the kernels twice
    return runs


def require_pixel_counts(columns: int, rows: int) -> None:
    """Refuse an image without pixels, or with more than 4096 a side.

    Raises:
        ProbeError: with the side that is wrong.
    """
    for name, count in (("columns", columns), ("rows", rows)):
        if not isinstance(count, int | np.integer) or not 1 <= count <= _MOST_PIXELS:
            raise ProbeError(
                f"the image has {count!r} {name}: give a whole number from 1 to {_MOST_PIXELS}"
            )
