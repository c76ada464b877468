"""Where the pixels of an image lie in the mesh, for all that is shown or known of them.

>>> import numpy as np
>>> from us_sim.slicing.cutting.located import Located
>>> shift = np.array([[[5.0, 1, 0], [5, 0, 0], [0, 0, 1]]])  # five voxels along the first two axes
>>> located = Located(np.zeros((2, 3), np.int32), np.concatenate([shift, shift]), np.array([7]))
>>> located.rest_index()[1, 2]
array([7., 5., 1.])
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.cutting.row_bands import parallel_rows

BLACK = -1
"""The element of a pixel that shows nothing, as where tissue moved away."""


class Located(NamedTuple):
    """The E tetrahedra that an image shows, and which of them each pixel lies in."""

    elements: NDArray[np.int32]  # (rows, columns) number of a map; E outside the mesh, or BLACK
    maps: NDArray[np.float64]  # (E + 1, 3, 3) from (1, column, row) to voxel indices at rest
    tetrahedra: NDArray[np.intp]  # (E,) the mesh's own numbers of those that maps are of

    def rest_index(self) -> NDArray[np.float64]:
        """(rows, columns, 3) voxel indices of where each pixel's tissue lies at rest.

        Outside the mesh that is the pixel itself; NaN where nothing is shown.
        """
        rows, columns = self.elements.shape
        column, row = np.meshgrid(np.arange(columns), np.arange(rows))
        pixel = np.stack([np.ones(column.shape), column, row], axis=-1)
        index = np.einsum("rcij,rcj->rci", self.maps[self.elements], pixel)
        index[self.elements == BLACK] = np.nan
        return np.asarray(index)

    def some(self, steps: tuple[int, int]) -> Located:
        """Every so many-th row and column of the elements, with the same maps."""
        elements = np.ascontiguousarray(self.elements[:: steps[0], :: steps[1]])
        return Located(elements, self.maps, self.tetrahedra)


def evaluate(
    maps: NDArray[np.float64], elements: NDArray[np.int32], *, threads: int = 1
) -> NDArray[np.float32]:
    """Values (rows, columns, K) of what is affine in (column, row) in each tetrahedron.

    Args:
        maps: (E, K, 3) coefficients of (1, column, row).
        elements: (rows, columns) as `Located.elements`.

    Returns:
        NaN wherever no tetrahedron is.
    """
    values = np.empty((*elements.shape, maps.shape[1]), dtype=np.float32)
    maps = np.ascontiguousarray(maps, dtype=np.float64)
    parallel_rows(
        threads, len(elements), lambda first, end: _evaluate(maps, elements, first, end, values)
    )
    return values


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate(maps, elements, first_row, end_row, values):
    """Fills rows of ``values`` (rows, columns, K) a run of pixels of one tetrahedron at a time."""
    columns = elements.shape[1]
    for row in range(first_row, end_row):
        line = elements[row]
        start = 0
        while start < columns:
            element = line[start]
            end = start + 1
            while end < columns and line[end] == element:
                end += 1
            for k in range(values.shape[2]):
                if element < 0 or element >= len(maps):
                    for i in range(start, end):
                        values[row, i, k] = np.nan
                    continue
                constant = maps[element, k, 0] + maps[element, k, 2] * row
                slope = maps[element, k, 1]
                for i in range(start, end):
                    values[row, i, k] = constant + slope * i
            start = end
