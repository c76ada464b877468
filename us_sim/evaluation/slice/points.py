"""One point of error against run time: a method, a case, and what it got wrong.

>>> from us_sim.evaluation.slice.points import Point
>>> Point("per_pixel", 256, 2000, 7695, 1).title
'per_pixel on 256 px, 2000 nodes'
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.row import Row, not_a_column
from us_sim.evaluation.run_times import RunTimes
from us_sim.evaluation.slice.cases import Frame
from us_sim.evaluation.slice.methods import Contender
from us_sim.evaluation.slice.reference import ExactSlice, voxel_distance
from us_sim.volume.volume import Volume

_AGAIN = 5  # images in a turn of a method that takes less than _SHORT
_SHORT = 8.0  # ms
_FEWEST = 3  # turns of each method that takes less than _SLOW
_SLOW = 150.0  # ms
_MOVED = 0.01
"""Voxels by which tissue must have moved before taking it for the rigid volume can be told."""
_ROUNDED = 0.5 + 1e-6  # grey levels


class Errors(NamedTuple):
    """How much an image differs from what it must show."""

    coverage_mismatch_px: int  # pixels that show tissue, the rigid volume or black wrongly
    max_grey_difference: float
    mean_grey_difference: float
    max_voxel_error: float  # of the place at rest, over the pixels without a mismatch


@dataclass(frozen=True)
class Point(Row):
    """A row of slice.csv, and what the report says beyond it."""

    method: str
    size: int  # columns, and rows
    nodes: int
    tets: int
    threads: int
    ms_median: float = float("nan")
    ms_p99: float = float("nan")
    coverage_mismatch_px: int = 0
    max_grey_difference: float = float("nan")
    mean_grey_difference: float = float("nan")
    max_voxel_error: float = float("nan")
    deformation: str = ""
    plane: str = ""
    cpu_ms_median: float = float("nan")  # processor time, of all threads
    filter_ms: float = float("nan")  # of VTK: finding pixels, processor time
    sampling_ms: float = float("nan")  # of VTK: sampling, processor time
    images: int = 0  # that were timed
    failure: str = not_a_column("")

    @property
    def title(self) -> str:
        """The method and what it cut."""
        return f"{self.method} on {self.size} px, {self.nodes} nodes"


@dataclass(frozen=True, eq=False)
class Timing(RunTimes):
    """How long one method's images took."""

    processor: NDArray[np.float64]  # ms, of all threads
    parts: tuple[float, float] = (float("nan"), float("nan"))  # ms, medians, where they are known


def timed_together(
    contenders: Sequence[Contender], frames: Sequence[Frame], seconds: float
) -> list[Timing]:
    """Times of all contenders, taken in turns, so that a noisy machine is as noisy for all.

    The probe moves on from image to image. Where a method says what parts its images took, their
    medians come too.

    Args:
        contenders: to be timed; each has cut an image before, so that nothing is compiled now.
        frames: what they cut, over and over.
        seconds: after which no further turn begins, if each has had a few; slow methods sit those
            few out.
    """
    found: list[list[float]] = [[] for _ in contenders]
    processor: list[list[float]] = [[] for _ in contenders]
    parts: list[list[tuple[float, float]]] = [[] for _ in contenders]
    begin = time.perf_counter()
    turn = 0
    while turn < _FEWEST or time.perf_counter() - begin < seconds:
        for number, contender in enumerate(contenders):
            if turn and min(found[number]) > _SLOW and time.perf_counter() - begin > seconds:
                continue
            for image in range(_AGAIN):
                frame = frames[(turn + image) % len(frames)]
                before, worked = time.perf_counter(), time.process_time()
                contender.image(frame)
                found[number].append((time.perf_counter() - before) * 1e3)
                processor[number].append((time.process_time() - worked) * 1e3)
                if contender.parts is not None:
                    parts[number].append(contender.parts())
                if min(found[number]) > _SHORT:
                    break
        turn += 1
    timings = []
    for wall, own, known in zip(found, processor, parts, strict=True):
        timing = Timing(np.array(wall), np.array(own))
        medians = tuple(np.median(known, axis=0).tolist()) if known else timing.parts
        timings.append(replace(timing, parts=medians))
    return timings


def compare(
    volume: Volume,
    frame: Frame,
    exact: ExactSlice,
    image: NDArray[np.uint8],
    rest: NDArray[np.float64],
    contrast: tuple[NDArray[np.float64], NDArray[np.uint8]] | None = None,
    tissue_only: bool = False,
) -> Errors:
    """How wrong an image (rows, columns), and where it took it from (rows, columns, 3) m, are.

    Args:
        volume: that was cut.
        frame: what was cut.
        exact: what it must show.
        image: grey values.
        rest: NaN where the method found nothing.
        contrast: what the image of a volume of black and white voxels must show, and the method's
            image of it: whatever the method says in ``rest``, there a pixel shows where it comes
            from, to half a grey level or 0.002 voxels.
        tissue_only: the method knows nothing of the rigid volume outside the mesh: grey values
            and places are compared where both find tissue.
    """
    right, wrong, expected = wrong_pixels(volume, frame, exact, rest, tissue_only)
    greys = right if tissue_only else np.ones(right.shape, dtype=np.bool_)
    grey = np.abs(image - np.rint(exact.grey))[greys]
    distance = voxel_distance(volume, rest, expected)[right].max(initial=0.0)
    if contrast is not None:
        shown, seen = contrast
        off = np.abs(seen - shown)[right].max(initial=0.0)
        # A value is rounded to a whole one, and from black to white is a voxel.
        distance = max(distance, (off - _ROUNDED) / 255.0)
    return Errors(
        int(wrong.sum()),
        float(grey.max(initial=0.0)),
        float(grey.mean()) if grey.size else 0.0,
        float(distance),
    )


def wrong_pixels(
    volume: Volume, frame: Frame, exact: ExactSlice, rest: NDArray[np.float64], tissue_only: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
    """Which pixels' coverage is right and which wrong; arguments as for `compare`.

    Returns:
        (rows, columns): where both show the same kind of thing and something; where they do not
        show the same; and (rows, columns, 3) m, where each pixel is from.
    """
    expected = np.where(exact.tissue[..., None], exact.rest, np.nan) if tissue_only else exact.rest
    known, seen = np.isfinite(expected[..., 0]), np.isfinite(rest[..., 0])
    pixels = frame.plane.pixels()
    moved = voxel_distance(volume, expected, pixels) > _MOVED
    seen_moved = voxel_distance(volume, rest, pixels) > _MOVED / 2
    # Tissue that hardly moved is where the rigid volume is, and shows the same.
    right = known & seen & ~(moved & ~seen_moved) & (exact.tissue | ~seen_moved)
    return right, (known | seen) & ~right, expected
