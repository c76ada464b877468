"""Volumes from the tracked images of a sweep."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.errors import VolumeError
from us_sim.volume.files.stored_image import check_memory
from us_sim.volume.reconstruction.grid import (
    Grid,
    find_outline,
    fit_grid,
    make_image_mask,
    propose_spacing,
)
from us_sim.volume.reconstruction.insertion import compute_means, fill_holes, insert_pixels
from us_sim.volume.reconstruction.settings import Compounding, ImagePart
from us_sim.volume.sequences.sweep import TrackedSweep
from us_sim.volume.volume import Volume

Rest = Callable[[int, NDArray[np.float64]], NDArray[np.float64]]
"""Takes the index of a frame and points (N, 3) m of it; where these lie while nothing presses."""

_LARGEST_PIXEL = 0.01  # m; a larger one is of a matrix that is no image's

_FILLING = 0.9  # fraction done when holes are filled


@dataclass(frozen=True, eq=False)
class InsertionPlan:
    """The images of a sweep and the grid that they are inserted into."""

    sweep: TrackedSweep
    grid: Grid
    used: NDArray[np.bool_]  # (rows, columns), the pixels that are inserted
    compounding: Compounding
    rest: Rest | None = None  # where the tissue of a frame lies at rest


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A volume, and how it came about."""

    volume: Volume
    covered: NDArray[np.bool_]  # (i, j, k) hit by a pixel, or filled
    filled: int  # voxels


def plan_insertion(
    sweep: TrackedSweep,
    compounding: Compounding,
    part: ImagePart | None = None,
    rest: Rest | None = None,
) -> InsertionPlan:
    """Find the grid around a sweep's images, and which of their pixels are used.

    Without a ``part`` of each image all of it is used; ``rest`` undoes the deformation of a frame.

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
    used = make_image_mask(part, sweep.columns, sweep.rows)
    points = np.einsum("kij,nj->kni", sweep.image_to_reference, find_outline(part, used))[..., :3]
    if rest is not None:
        points = np.stack([rest(k, frame) for k, frame in enumerate(points)])
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise VolumeError(f"{sweep.path}: no pixel of its images lies in the tissue of the scene")
    spacing = compounding.spacing or propose_spacing(points, pixel)
    return InsertionPlan(sweep, fit_grid(points, spacing), used, compounding, rest)


def reconstruct(planned: InsertionPlan, progress: Progress | None = None) -> Reconstruction:
    """Make the volume of a sweep's images.

    Raises:
        VolumeError: the images are damaged, the free memory does not hold the volume, or nothing
            of them lies in the grid.
    """
    sweep, shape = planned.sweep, planned.grid.shape
    frames = len(sweep.numbers)
    tell = progress or (lambda *_: None)
    voxels = f"a volume of {' × '.join(map(str, shape))} voxels"
    check_memory(10 * math.prod(shape), voxels, "give a larger --spacing")
    total, count = np.zeros(shape, np.uint32), np.zeros(shape, np.uint32)
    rows, columns = np.nonzero(planned.used)
    pixels = np.column_stack([columns, rows, np.zeros(len(rows))])
    to_index = np.linalg.inv(planned.grid.index_to_reference)
    placed = zip(sweep.read_images(), sweep.image_to_reference, strict=True)
    for k, (image, matrix) in enumerate(placed):
        tell(_FILLING * k / frames, "inserting images")
        points, to_grid = pixels, to_index @ matrix
        if planned.rest is not None:
            points = planned.rest(k, pixels @ matrix[:3, :3].T + matrix[:3, 3])
            to_grid = to_index
        insert_pixels(image[planned.used], points, to_grid[:3], total, count)
    grey, covered = compute_means(total, count)
    del total, count
    if not covered.any():
        raise VolumeError(f"{sweep.path}: no pixel of its images lies in the grid")
    tell(_FILLING, "filling holes")
    asked = planned.compounding.hole_radius
    filled = fill_holes(grey, covered, 2.0 if asked is None else asked / planned.grid.spacing)
    tell(1.0, "")
    volume = Volume(grey, planned.grid.index_to_reference)
    return Reconstruction(volume, covered, filled)
