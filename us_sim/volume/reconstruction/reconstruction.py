"""Volumes from the tracked images of a sweep."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.volume.reconstruction.grid import (
    Grid,
    grid_around,
    image_mask,
    outline,
    proposed_spacing,
)
from us_sim.volume.reconstruction.insertion import Insertion, fill_holes
from us_sim.volume.reconstruction.settings import Compounding, ImagePart
from us_sim.volume.sequences.sweep import Sweep
from us_sim.volume.volume import Volume

Progress = Callable[[float, str], None]  # is told the fraction done, and the work in progress

Rest = Callable[[int, NDArray[np.float64]], NDArray[np.float64]]
"""Takes the index of a frame and points (N, 3) m of it; where these lie while nothing presses."""

_TILE = 32  # pixels along a side
_LARGEST_PIXEL = 0.01  # m; a larger one is of a matrix that is no image's

APART = 8
"""Frames from one that is left out to the next: the seven between are enough to predict it."""

_FILLING = 0.9  # fraction done when holes are filled


@dataclass(frozen=True, eq=False)
class Plan:
    """The images of a sweep and the grid that they are inserted into."""

    sweep: Sweep
    grid: Grid
    used: NDArray[np.bool_]  # (rows, columns), the pixels that are inserted
    compounding: Compounding
    rest: Rest | None = None  # where the tissue of a frame lies at rest

    @property
    def hole_radius(self) -> float:
        """m; two voxels where nobody says."""
        asked = self.compounding.hole_radius
        return 2.0 * self.grid.spacing if asked is None else asked

    @cached_property
    def _pixels(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows (N,) and columns (N,) of the used pixels, tile by tile.

        So voxels are in the cache when the next row of pixels comes to them.
        """
        rows, columns = np.nonzero(self.used)
        order = np.lexsort((columns, rows, columns // _TILE, rows // _TILE))
        return rows[order], columns[order]

    @cached_property
    def _points(self) -> NDArray[np.float64]:
        """(N, 3) of the used pixels in an image: column, row and 0."""
        rows, columns = self._pixels
        return np.column_stack([columns, rows, np.zeros(len(rows))])

    def values(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the used pixels (N,) of an image."""
        return image[self._pixels]

    def places(self, k: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points (N, 3) of a frame's used pixels, and what takes them to the grid (3, 4).

        They are at rest where that is known.
        """
        points = self._points
        to_index, matrix = self.grid.reference_to_index, self.sweep.image_to_reference[k]
        if self.rest is None:
            return points, (to_index @ matrix)[:3]
        return self.rest(k, points @ matrix[:3, :3].T + matrix[:3, 3]), to_index[:3]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A volume, and how it came about."""

    volume: Volume
    covered: NDArray[np.bool_]  # (i, j, k) hit by a pixel, or filled
    frames: int
    hit: int  # voxels
    filled: int


def plan(
    sweep: Sweep,
    compounding: Compounding,
    part: ImagePart | None = None,
    rest: Rest | None = None,
) -> Plan:
    """The grid around a sweep's images, and which of their pixels are used.

    Args:
        sweep: with poses.
        compounding: how; its spacing may be proposed.
        part: of each image; all without it.
        rest: undoes the deformation of a frame.

    Raises:
        VolumeError: the matrices are not an image's, no pixel is used, or the grid would be too
            large or too flat.
    """
    pixel = float(np.linalg.norm(sweep.image_to_reference[:, :3, :2], axis=1).mean())
    if pixel > _LARGEST_PIXEL:
        raise VolumeError(
            f"{sweep.path}: its transforms make pixels of {1e3 * pixel:g} mm, so they are not "
            f"those of an image: name its frame by --image, or give the probe's --calibration"
        )
    part = part or ImagePart()
    used = image_mask(part, sweep.columns, sweep.rows)
    points = np.einsum("kij,nj->kni", sweep.image_to_reference, outline(part, used))[..., :3]
    if rest is not None:
        points = np.stack([rest(k, frame) for k, frame in enumerate(points)])
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise VolumeError(f"{sweep.path}: no pixel of its images lies in the tissue of the scene")
    spacing = compounding.spacing or proposed_spacing(points, pixel)
    return Plan(sweep, grid_around(points, spacing), used, compounding, rest)


def reconstruct(
    planned: Plan, which: Sequence[int] | None = None, progress: Progress | None = None
) -> Reconstruction:
    """The volume of a sweep's images.

    Args:
        planned: the sweep and its grid.
        which: indices of the frames that are inserted, ascending; all without it.
        progress: is told how far it is.

    Raises:
        VolumeError: the images are damaged, the free memory does not hold the volume, or nothing
            of them lies in the grid.
    """
    sweep, settings = planned.sweep, planned.compounding
    frames = list(range(len(sweep.numbers)) if which is None else which)
    tell = progress or (lambda *_: None)
    inserted = Insertion(planned.grid, method=settings.method, compounding=settings.compounding)
    if inserted.is_median:
        for k in frames:
            inserted.count(*planned.places(k))
    for done, (k, image) in enumerate(zip(frames, sweep.images(frames), strict=True)):
        tell(_FILLING * done / len(frames), "inserting images")
        inserted.insert(planned.values(image), *planned.places(k))
    grey, covered = inserted.result()
    del inserted
    hit = int(np.count_nonzero(covered))
    if not hit:
        raise VolumeError(f"{sweep.path}: no pixel of its images lies in the grid")
    tell(_FILLING, "filling holes")
    filled = fill_holes(grey, covered, planned.hole_radius / planned.grid.spacing)
    tell(1.0, "")
    volume = Volume(grey, planned.grid.index_to_reference)
    return Reconstruction(volume, covered, len(frames), hit, filled)


@dataclass(frozen=True, eq=False)
class Prediction:
    """How like the frames left out and their predictions are."""

    frames: NDArray[np.int64]  # (N,) numbers of the frames in the file
    correlations: NDArray[np.float64]  # (N,) normalised cross-correlation; nan where not covered


def leave_one_out(planned: Plan, count: int, progress: Progress | None = None) -> Prediction:
    """Predict some frames of a sweep from all others: cut them from the volume of the others.

    This tests the whole chain of calibration, tracking and compounding. The frames are spread over
    the sweep, with seven others between two of them or more, so that each is predicted as if it
    alone were left out; one reconstruction does for all of them.

    Args:
        planned: the sweep and its grid.
        count: how many frames, fewer where the sweep is short.
        progress: is told how far it is.

    Raises:
        VolumeError: the sweep has fewer than three frames, or the others predict nothing of those.
    """
    sweep = planned.sweep
    total = len(sweep.numbers)
    if total < 3:
        raise VolumeError(f"{sweep.path}: has {total} usable frames; leaving one out needs 3")
    count = max(1, min(count, total // APART))
    chosen = np.unique(np.linspace(0, total - 1, count + 2).round().astype(int)[1:-1])
    others = np.setdiff1d(np.arange(total), chosen)
    made = reconstruct(planned, [int(k) for k in others], progress)
    found = np.array(
        [
            _predicted(planned, made, int(k), image)
            for k, image in zip(chosen, sweep.images(chosen.tolist()), strict=True)
        ]
    )
    if np.isnan(found).all():
        raise VolumeError(
            f"{sweep.path}: the other frames predict nothing of the {len(chosen)} left out: the "
            f"frames are too far apart; give a larger --hole-radius or --spacing"
        )
    return Prediction(sweep.numbers[chosen], found)


def correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Pearson's correlation; nan where one is constant."""
    first, second = first - first.mean(), second - second.mean()
    scale = math.sqrt(float(first @ first) * float(second @ second))
    return float(first @ second) / scale if scale else math.nan


def _predicted(planned: Plan, made: Reconstruction, k: int, image: NDArray[np.uint8]) -> float:
    """The correlation of a frame with its prediction, where its pixels' eight voxels are covered.

    It is nan for fewer than 100 such pixels.
    """
    points, matrix = planned.places(k)
    index = matrix[:, :3] @ points.T + matrix[:, 3:]
    whole = ndimage.map_coordinates(made.covered.view(np.uint8), index, np.float32, order=1)
    used = np.isfinite(index[0]) & (whole > 1.0 - 1e-5)
    if used.sum() < 100:
        return math.nan
    predicted = ndimage.map_coordinates(
        made.volume.intensities, index[:, used], np.float64, order=1
    )
    return correlation(planned.values(image)[used].astype(np.float64), predicted)
