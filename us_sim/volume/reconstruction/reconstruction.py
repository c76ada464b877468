"""A volume from a tracked sweep: its grid, its images inserted, its holes filled.

>>> import pathlib, tempfile
>>> from us_sim.volume.reconstruction.reconstruction import plan, reconstruct
>>> from us_sim.volume.reconstruction.settings import Compounding
>>> from us_sim.volume.sequences.sweep import read_sweep
>>> header = ["ObjectType = Image", "NDims = 3", "DimSize = 4 3 5", "ElementType = MET_UCHAR"]
>>> for k in range(5):
...     pose = f"1 0 0 9 0 1 0 0 0 0 1 {k} 0 0 0 1"
...     header.append(f"Seq_Frame000{k}_ImageToReferenceTransform = {pose}")
...     header.append(f"Seq_Frame000{k}_Timestamp = 0.{k}")
>>> text = "\\n".join([*header, "ElementDataFile = LOCAL", ""])
>>> with tempfile.TemporaryDirectory() as folder:
...     path = pathlib.Path(folder, "sweep.igs.mha")
...     _ = path.write_bytes(text.encode() + bytes(range(60)))
...     made = reconstruct(plan(read_sweep(path), Compounding(spacing=0.001)))
>>> made.volume.shape, made.volume.intensities[3, 2].tolist()
((4, 3, 5), [11, 23, 35, 47, 59])
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.reconstruction.grid import (
    Grid,
    axes_of_smallest_box,
    grid_around,
    proposed_spacing,
)
from us_sim.volume.reconstruction.hole_filling import fill_holes
from us_sim.volume.reconstruction.image_mask import image_mask, outline
from us_sim.volume.reconstruction.insertion import Collection, Insertion
from us_sim.volume.reconstruction.settings import Compounding, ImagePart
from us_sim.volume.sequences.sweep import Sweep
from us_sim.volume.volume import Volume

Progress = Callable[[float, str], None]
"""Is told the fraction done, and what is being done."""

Rest = Callable[[int, NDArray[np.float64]], NDArray[np.float64]]
"""Takes the index of a frame and points (N, 3) m of it; where these lie while nothing presses."""

_HOLES = 2.0  # voxels, where nobody says
_FILLING = 0.9  # fraction done when holes are filled


@dataclass(frozen=True, eq=False)
class Plan:
    """What is inserted where."""

    sweep: Sweep
    grid: Grid
    used: NDArray[np.bool_]  # (rows, columns), the pixels that are inserted
    compounding: Compounding
    rest: Rest | None = None  # where the tissue of a frame lies at rest

    @property
    def hole_radius(self) -> float:
        """m."""
        asked = self.compounding.hole_radius
        return _HOLES * self.grid.spacing if asked is None else asked


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
    *,
    smallest_box: bool = False,
    rest: Rest | None = None,
) -> Plan:
    """The grid around a sweep's images, and which of their pixels are used.

    Args:
        sweep: with poses.
        compounding: how; its spacing may be proposed.
        part: of each image; all without it.
        smallest_box: turn the grid so that it has few voxels; else its axes are the sweep's.
        rest: undoes the deformation of a frame.

    Raises:
        VolumeError: no pixel is used, or the grid would be too large or too flat.
    """
    part = part or ImagePart()
    used = image_mask(part, sweep.columns, sweep.rows)
    around = outline(part, used)
    points = np.einsum("kij,nj->kni", sweep.image_to_reference, around)[..., :3]
    if rest is not None:
        points = np.stack([rest(k, frame) for k, frame in enumerate(points)])
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise VolumeError(f"{sweep.path}: no pixel of its images lies in the tissue of the scene")
    axes = axes_of_smallest_box(points, sweep.image_to_reference) if smallest_box else None
    spacing = compounding.spacing
    if spacing is None:
        steps = np.linalg.norm(sweep.image_to_reference[:, :3, :2], axis=1)
        spacing = proposed_spacing(points, float(steps.mean()), axes)
    return Plan(sweep, grid_around(points, spacing, axes), used, compounding, rest)


def reconstruct(
    planned: Plan, which: Sequence[int] | None = None, progress: Progress | None = None
) -> Reconstruction:
    """The volume of a sweep's images.

    Args:
        planned: what is inserted where.
        which: indices of the frames that are inserted, ascending; all without it.
        progress: is told how far it is.

    Raises:
        VolumeError: the images are damaged, the free memory does not hold the volume, or nothing
            of them lies in the grid.
    """
    sweep, settings = planned.sweep, planned.compounding
    frames = list(range(len(sweep.numbers)) if which is None else which)
    tell = progress or (lambda *_: None)
    if settings.compounding == "median":
        grey, covered = _medians(planned, frames, tell)
    else:
        inserted = Insertion(
            planned.grid,
            method=settings.method,
            compounding=settings.compounding,
            plus_rounding=settings.plus_rounding,
        )
        for done, (k, image) in enumerate(zip(frames, sweep.images(frames), strict=True)):
            tell(_FILLING * done / len(frames), "inserting images")
            if planned.rest is None:
                inserted.insert(image, sweep.image_to_reference[k], planned.used)
            else:
                points = planned.rest(k, _places(planned, k))
                inserted.insert_points(image[planned.used], points)
        grey, covered = inserted.result()
        del inserted
    hit = int(np.count_nonzero(covered))
    if not hit:
        raise VolumeError(f"{sweep.path}: no pixel of its images lies in the grid")
    tell(_FILLING, "filling holes")
    filled = fill_holes(grey, covered, planned.hole_radius / planned.grid.spacing)
    tell(1.0, "")
    return Reconstruction(
        Volume(grey, planned.grid.index_to_reference), covered, len(frames), hit, filled
    )


def _places(planned: Plan, k: int) -> NDArray[np.float64]:
    """(N, 3) m of a frame's used pixels."""
    rows, columns = np.nonzero(planned.used)
    matrix = planned.sweep.image_to_reference[k]
    return columns[:, None] * matrix[:3, 0] + rows[:, None] * matrix[:3, 1] + matrix[:3, 3]


def _medians(
    planned: Plan, frames: Iterable[int], tell: Progress
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    frames = list(frames)
    sweep, used = planned.sweep, planned.used
    if planned.rest is not None:
        raise VolumeError("compounding by the median cannot undo the pressure: use mean or max")
    pixels = Collection(planned.grid, method=planned.compounding.method)
    for k in frames:
        pixels.count(sweep.image_to_reference[k], used)
    pixels.reserve()
    for done, (k, image) in enumerate(zip(frames, sweep.images(frames), strict=True)):
        tell(_FILLING * done / len(frames), "inserting images")
        pixels.insert(image, sweep.image_to_reference[k], used)
    return pixels.result()
