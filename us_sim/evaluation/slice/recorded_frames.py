"""Simulated images beside those that a real probe recorded at the same poses.

A freehand sweep was compounded to a volume; cutting that volume along the sweep's own poses must
give back its images, but for what compounding blurred. This puts to the test, on real data, the
whole path from a pose to an image: the probe's geometry, the frames and their units, the slicer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.report_folder import write_rows
from us_sim.evaluation.slice.recorded_fan import LIVER_SWEEP, RecordedFan
from us_sim.evaluation.slice.recorded_pairs import (
    LARGEST_SHIFT,
    MARGIN,
    RESOLUTION,
    SHIFT_STEP,
    RecordedFrame,
    RecordedPairs,
)
from us_sim.evaluation.slice.recorded_pictures import draw_recorded
from us_sim.slicing.probe.probe import ConvexProbe
from us_sim.volume.files.readers import read_volume
from us_sim.volume.sequences.sweep import read_sweep

_ATTRIBUTION = "Data: ImFusion GmbH, CC BY 4.0"
_ASKED = 0.8  # normalised cross-correlation
_HEAD = ("normalised cross-correlation with", "lowest", "median", "highest", "at least 0.8")
_SHOWN = 6  # frames in the picture
_QUICK = 10  # every so many frames are compared in a quick run


@dataclass(frozen=True, eq=False)
class RecordedComparison:
    """What `compare_with_recorded` found."""

    rows: Sequence[RecordedFrame]
    shifts: NDArray[np.float64]  # (P, 3) m, along x, y, z of the probe, that would fit best
    left_out: int  # frames of the sweep without a usable pose or time
    probe: ConvexProbe
    files: Sequence[Path]

    @property
    def lowest(self) -> float:
        """The least correlation of any frame as it was recorded."""
        return min(row.ncc_raw for row in self.rows)

    def markdown(self) -> str:
        """A paragraph, a table and what follows from it, for a report."""
        probe = self.probe
        coverage = np.mean([row.coverage for row in self.rows])
        rows = []
        for name, words in (
            ("ncc_raw", "the frame as recorded"),
            ("ncc_smoothed", f"it, smoothed by {1e3 * RESOLUTION:g} mm, as the volume is"),
            ("ncc_mirrored", "the smoothed frame, left and right swapped"),
        ):
            ncc = np.array([getattr(row, name) for row in self.rows])
            numbers = (f"{x:.3f}" for x in (ncc.min(), np.median(ncc), ncc.max()))
            rows.append((words, *numbers, f"{(ncc >= _ASKED).sum()} of {len(ncc)}"))
        lateral, elevation, axial = 1e3 * np.abs(self.shifts).max(axis=0)
        parts = [
            f"{len(self.rows)} recorded frames beside the volume cut at their poses: a curved "
            f"array of {1e3 * probe.radius:.1f} mm radius, "
            f"{math.degrees(probe.opening_angle):.1f}° and {1e3 * probe.depth:.0f} mm depth, "
            f"{probe.columns} × {probe.rows} pixels of {1e3 * probe.pixel_spacing[1]:.3f} mm. "
            f"They are compared in the fan, {1e3 * MARGIN:g} mm or more inside what the sweep "
            f"covers ({100 * coverage:.0f} % of the fan). {self.left_out} frames had no "
            f"usable pose.",
            markdown_table(_HEAD, rows),
            "The volume is the mean of these very frames: this shows that poses, geometry and "
            "sampling are right, not how well an unseen image would be foretold. Tissue at rest "
            "and the volume without tissue differ by "
            f"{max(row.grey_difference_rigid for row in self.rows)} grey levels at most. Of all "
            f"shifts by up to {1e3 * LARGEST_SHIFT:.1f} mm (in steps of {1e3 * SHIFT_STEP:.1f} "
            f"mm, judged by structures of 1 to 5 mm in {len(self.shifts)} frames), those that fit "
            f"best are at most {lateral:.1f} mm along the array, {axial:.1f} mm along the depth "
            f"and {elevation:.1f} mm across the image. "
            f"{_ATTRIBUTION}.",
        ]
        return "\n\n".join(parts)


def compare_with_recorded(
    volume_file: Path,
    sweep_file: Path,
    out: Path,
    quick: bool,
    *,
    fan: RecordedFan = LIVER_SWEEP,
    method: str = "scan_conversion",
) -> RecordedComparison:
    """Compare the frames of a sweep (quick: every tenth) with the volume made from them.

    Writes recorded_frames.csv and recorded_frames.png into ``out``.

    Args:
        fan: where the probe's image lies in the recorded frames.
        method: the slicer's name.

    Raises:
        VolumeError: a file cannot be read, the sweep's images do not hold the fan, or the volume
            covers nothing of a frame.
    """
    volume, sweep = read_volume(volume_file), read_sweep(sweep_file)
    frames = RecordedPairs.of(volume, sweep, fan, method)
    chosen = list(range(0, len(sweep.numbers), _QUICK if quick else 1))
    shown = {chosen[i] for i in np.linspace(0, len(chosen) - 1, _SHOWN).round().astype(int)}
    rows, pairs, shifts = [], [], []
    for index, image in zip(chosen, sweep.images(chosen), strict=True):
        pair = frames.pair(sweep, index, image)
        rows.append(frames.compare(pair, float(sweep.times[index])))
        if index in shown:
            pairs.append(pair)
            shifts.append(frames.best_shift(pair))
    out.mkdir(parents=True, exist_ok=True)
    table, picture = out / "recorded_frames.csv", out / "recorded_frames.png"
    write_rows(table, rows)
    draw_recorded(rows, pairs, frames.probe, _ATTRIBUTION, picture)
    left_out = sum(sweep.left_out.values())
    return RecordedComparison(rows, np.array(shifts), left_out, frames.probe, (table, picture))
