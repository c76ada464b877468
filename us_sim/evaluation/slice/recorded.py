"""Simulated images beside those that a real probe recorded at the same poses.

A freehand sweep was compounded to a volume; cutting that volume along the sweep's own poses must
give back its images, but for the blur of compounding. This tests the whole path from a pose to an
image on real data: the probe's geometry, the frames and their units, the slicer.

>>> import numpy as np
>>> from us_sim.evaluation.slice.recorded import LIVER_SWEEP, normalised_cross_correlation
>>> probe = LIVER_SWEEP.probe(0.314818e-3)
>>> round(probe.radius * 1e3, 2), round(probe.depth * 1e3, 2), probe.rows
(50.79, 177.25, 585)
>>> image = np.array([[1.0, 2.0], [3.0, 9.0]])
>>> round(normalised_cross_correlation(image, 5.0 - 2.0 * image, np.ones((2, 2), bool)), 12)
-1.0
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.evaluation.report import Row, filled, markdown_table, picture, write_rows
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.resampling import sample_plane
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import ConvexProbe, Probe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.files.readers import read_volume
from us_sim.volume.reconstruction.reconstruction import correlation
from us_sim.volume.sequences.sweep import Sweep, read_sweep
from us_sim.volume.volume import Volume

_ATTRIBUTION = "Data: ImFusion GmbH, CC BY 4.0"


@dataclass(frozen=True)
class RecordedFan:
    """Where a curved array's image lies in a recorded frame, in pixels.

    Positions are those of pixel centres, so that the first pixel's centre is (0, 0).
    """

    column: float  # of the face's middle
    row: float
    radius: float  # of the face
    end: float  # radius at which the beams end
    half_angle: float  # rad

    def fits(self, columns: int, rows: int) -> bool:
        """Whether images of that size hold the whole fan, to half a pixel."""
        reach = self.end * math.sin(self.half_angle)
        bottom = self.row + self.end - self.radius
        across = reach - 0.5 <= self.column <= columns - 0.5 - reach
        return across and bottom <= rows - 0.5

    def probe(self, spacing: float) -> ConvexProbe:
        """The probe with pixels ``spacing`` m wide, as near as a whole number of them allows."""
        depth = (self.end - self.radius) * spacing
        radius = self.radius * spacing
        height = depth + radius * (1.0 - math.cos(self.half_angle))
        probe = ConvexProbe(radius=radius, opening_angle=2.0 * self.half_angle, depth=depth)
        return probe.with_square_pixels(round(height / spacing))

    def pose(self, image_to_reference: NDArray[np.float64]) -> Pose:
        """Of the probe in the sweep's frame, from a frame's (4, 4) matrix in metres."""
        along, down = (step / np.linalg.norm(step) for step in image_to_reference[:3, :2].T)
        matrix = np.eye(4)
        matrix[:3, :3] = np.column_stack([along, np.cross(down, along), down])
        matrix[:3, 3] = (image_to_reference @ [self.column, self.row, 0.0, 1.0])[:3]
        return Pose.from_matrix(matrix)

    def on_probe_pixels(
        self, frame: NDArray[np.uint8], probe: ConvexProbe, spacing: float
    ) -> NDArray[np.uint8]:
        """A recorded frame on the pixels of a probe's image, bilinear."""
        to_pixel = probe.image_to_probe[[0, 2]][:, [0, 1, 3]] / spacing
        to_pixel[:, 2] += (self.column, self.row)
        size = (probe.columns, probe.rows)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(frame, to_pixel, size, flags=flags), dtype=np.uint8)


LIVER_SWEEP = RecordedFan(369.0, 22.01, 161.34, 724.35, math.radians(30.28))
"""The curved array of ImFusion's public liver sweep, as the header of their own file has it.

The frames confirm the face and the sides to a pixel; they are lit 9 pixels (3 mm) deeper than the
header's end, to their last row.
"""


RESOLUTION = 1e-3
"""m, standard deviation of the Gaussian that smooths a frame to its volume's resolution."""

MARGIN = 2e-3
"""m, from the border of the swept region; nearer, few frames were averaged: not compared."""

SHIFT_STEP = 0.63e-3  # m, between the shifts that are tried; about two pixels of the liver sweep

_SHIFTS = SHIFT_STEP * np.arange(-3, 4)


@dataclass(frozen=True)
class RecordedFrame(Row):
    """How like a recorded frame its simulated image is; a row of recorded_frames.csv."""

    digits = 6

    frame: int
    time: float  # s
    coverage: float  # fraction of the fan in which the two are compared
    ncc_raw: float  # normalised cross-correlation with the frame as it was recorded
    ncc_smoothed: float  # with the frame smoothed to the volume's resolution
    ncc_mirrored: float  # smoothed, left and right swapped, as of a wrong image
    grey_difference_rigid: int  # largest, between tissue at rest and the volume without tissue


@dataclass(frozen=True, eq=False)
class RecordedPair:
    """A recorded frame and its simulated image, on the same pixels."""

    frame: int
    pose: Pose  # of the probe, in the sweep's frame
    recorded: NDArray[np.uint8]  # (rows, columns)
    simulated: NDArray[np.uint8]  # (rows, columns)
    compared: NDArray[np.bool_]  # (rows, columns), where both hold the tissue


class RecordedPairs:
    """Makes and compares the pairs of one sweep, with a box of tissue around the volume.

    Raises:
        VolumeError: the sweep's images are of another kind than the fan's.
    """

    def __init__(self, volume: Volume, sweep: Sweep, fan: RecordedFan, method: str) -> None:
        steps = sweep.image_to_reference[:, :3, :2]
        sizes = np.linalg.norm(steps, axis=1)
        self.spacing = float(sizes.mean())  # m, of the recorded pixels
        slant = np.einsum("ki,ki->k", steps[:, :, 0], steps[:, :, 1]) / self.spacing**2
        if max(np.abs(sizes / self.spacing - 1.0).max(), np.abs(slant).max()) > 1e-3:
            raise VolumeError(
                f"{sweep.path}: its pixels are not squares of one size ({1e3 * sizes.min():g} to "
                f"{1e3 * sizes.max():g} mm); give a sweep that was taken at one depth"
            )
        if not fan.fits(sweep.columns, sweep.rows):
            raise VolumeError(
                f"{sweep.path}: its images of {sweep.columns} × {sweep.rows} pixels do not hold "
                f"the probe's fan; give the sweep that this fan belongs to"
            )
        sides = zip(*volume.extent, (24, 20, 16), strict=True)
        mesh = box_mesh(*(uniform_planes(a, b, n) for a, b, n in sides))
        covered = np.where(volume.intensities > 0, np.uint8(255), np.uint8(0))
        self.volume, self.fan, self.probe = volume, fan, fan.probe(self.spacing)
        self.support = Volume(covered, volume.index_to_patient)
        self.slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra)
        self.nodes = mesh.nodes  # (N, 3) m, of the tissue at rest

    def pair(self, sweep: Sweep, index: int, image: NDArray[np.uint8]) -> RecordedPair:
        """A recorded frame, and the volume cut at its pose.

        Raises:
            VolumeError: the volume covers nothing of it.
        """
        pose = self.fan.pose(sweep.image_to_reference[index])
        plane = self.probe.plane(pose)
        compared = self._covered(plane)
        number = int(sweep.numbers[index])
        if not compared.any():
            raise VolumeError(
                f"{sweep.path}: the volume covers nothing of frame {number}; give the volume that "
                f"was compounded from this sweep, in the sweep's frame"
            )
        recorded = self.fan.on_probe_pixels(image, self.probe, self.spacing)
        return RecordedPair(number, pose, recorded, self.slicer.image(self.nodes, plane), compared)

    def compare(self, pair: RecordedPair, time: float) -> RecordedFrame:
        """How like the two are."""
        plane = self.probe.plane(pair.pose)
        shown = plane.is_shown()
        rigid = np.where(shown, sample_plane(self.volume, plane), np.uint8(0))
        smoothed = self._smoothed(pair.recorded, RESOLUTION)
        compared, simulated = pair.compared, pair.simulated
        both = compared & compared[:, ::-1]
        return RecordedFrame(
            pair.frame,
            time,
            float(compared.sum() / shown.sum()),
            normalised_cross_correlation(pair.recorded, simulated, compared),
            normalised_cross_correlation(smoothed, simulated, compared),
            normalised_cross_correlation(smoothed, simulated[:, ::-1], both),
            int(np.abs(simulated.astype(np.int16) - rigid).max()),
        )

    def best_shift(self, pair: RecordedPair) -> NDArray[np.float64]:
        """(3,) m, along x, y, z of the probe: how far to move the cut for the best fit.

        Judged by structures of 1 to 5 mm, since larger ones hardly mind a shift.
        """
        recorded = self._structures(pair.recorded)
        simulated = self._structures(pair.simulated)
        found: dict[tuple[float, float, float], float] = {}
        pixels = (_SHIFTS / self.spacing).round().astype(int).tolist()
        for lateral in pixels:
            for axial in pixels:
                shift = (lateral * self.spacing, 0.0, axial * self.spacing)
                moved = np.roll(recorded, (axial, lateral), axis=(0, 1))
                found[shift] = normalised_cross_correlation(moved, simulated, pair.compared)
        for elevation in _SHIFTS.tolist():
            shift = (0.0, elevation, 0.0)
            position = pair.pose.apply(np.array([shift]))[0]
            plane = self.probe.plane(replace(pair.pose, position=position))
            cut = self._structures(sample_plane(self.volume, plane))
            both = pair.compared & self._covered(plane)
            found[shift] = normalised_cross_correlation(recorded, cut, both)
        return np.array(max(found, key=lambda shift: (found[shift], -np.linalg.norm(shift))))

    def _covered(self, plane: SlicePlane) -> NDArray[np.bool_]:
        """(rows, columns): in the fan, and not near the border of the swept region."""
        covered = (sample_plane(self.support, plane) == 255) & plane.is_shown()
        width = 2 * round(MARGIN / self.spacing) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        # The image's own border counts too.
        eroded = cv2.erode(
            covered.astype(np.uint8), disc, borderType=cv2.BORDER_CONSTANT, borderValue=0
        )
        return np.asarray(eroded, dtype=np.bool_)

    def _structures(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._smoothed(image, RESOLUTION) - self._smoothed(image, 5e-3)

    def _smoothed(self, image: NDArray[np.uint8], width: float) -> NDArray[np.float32]:
        """By a Gaussian of that standard deviation, m."""
        pixels = width / self.spacing
        blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), pixels)
        return np.asarray(blurred, dtype=np.float32)


def normalised_cross_correlation(
    a: NDArray[np.generic], b: NDArray[np.generic], where: NDArray[np.bool_]
) -> float:
    """Pearson's correlation of two images over some of their pixels; NaN where one is constant."""
    if np.count_nonzero(where) < 2:
        return math.nan
    return correlation(a[where].astype(np.float64), b[where].astype(np.float64))


def _draw_recorded(
    rows: Sequence[RecordedFrame], pairs: Sequence[RecordedPair], probe: Probe, file: Path
) -> None:
    """A column a pair: recorded, simulated, their difference; below, all frames' correlation."""
    white = float(np.percentile([pair.recorded for pair in pairs], 99.2))  # few pixels are bright
    corner = 1e3 * (probe.image_to_probe @ [-0.5, -0.5, 0, 1])
    end = 1e3 * (probe.image_to_probe @ [probe.columns - 0.5, probe.rows - 0.5, 0, 1])
    look: Any = {"extent": (corner[0], end[0], end[2], corner[2])}
    grey: Any = {"cmap": "gray", "vmin": 0.0, "vmax": white}
    by_frame = {row.frame: row for row in rows}
    title = "Real frames of a freehand sweep, and the volume made from it cut at their poses"
    with picture(file, 2.9 * len(pairs) + 0.8, 9.6, f"{title}.  {_ATTRIBUTION}") as figure:
        grid = figure.add_gridspec(4, len(pairs), height_ratios=(1, 1, 1, 0.7))
        for column, pair in enumerate(pairs):
            difference = pair.simulated.astype(np.float32) - pair.recorded
            difference[~pair.compared] = np.nan
            row = by_frame[pair.frame]
            top, middle, bottom = (figure.add_subplot(grid[line, column]) for line in range(3))
            top.imshow(pair.recorded, **grey, **look)
            middle.imshow(pair.simulated, **grey, **look)
            shown = bottom.imshow(difference, cmap="RdBu_r", vmin=-40.0, vmax=40.0, **look)
            top.set_title(f"frame {pair.frame}, t = {row.time:.2f} s", fontsize=10)
            bottom.set_xlabel(f"NCC {row.ncc_raw:.3f}; smoothed {row.ncc_smoothed:.3f}")
            names = ("recorded", "simulated", "simulated − recorded")
            for axes, name in zip((top, middle, bottom), names, strict=True):
                axes.tick_params(labelsize=7, labelbottom=axes is bottom, labelleft=column == 0)
                if column == 0:
                    axes.set_ylabel(f"{name}\ndepth, mm")
        figure.colorbar(shown, ax=bottom, shrink=0.8, label="grey levels")
        _plot_correlation(figure.add_subplot(grid[3, :]), rows)


def _plot_correlation(axes: Axes, rows: Sequence[RecordedFrame]) -> None:
    frames = [row.frame for row in rows]
    for name, words, colour, mark in (
        ("ncc_smoothed", "smoothed to the volume's resolution", "#0072B2", "s"),
        ("ncc_raw", "as recorded", "#D55E00", "o"),
        ("ncc_mirrored", "smoothed, left and right swapped", "0.6", "x"),
    ):
        values = [getattr(row, name) for row in rows]
        axes.plot(frames, values, color=colour, marker=mark, ms=3.5, lw=1, label=words)
    axes.axhline(0.8, color="0.3", ls=":", lw=1.2, label="asked: 0.8")
    axes.set_xlabel("frame")
    axes.set_ylabel("normalised\ncross-correlation")
    axes.set_ylim(0, 1.06)
    axes.margins(x=0.01)
    axes.legend(loc="lower left", fontsize=9, ncols=4)


@dataclass(frozen=True, eq=False)
class RecordedComparison:
    """Result of `compare_with_recorded`."""

    rows: Sequence[RecordedFrame]
    shifts: NDArray[np.float64]  # (P, 3) m, along x, y, z of the probe, that would fit best
    left_out: int  # frames of the sweep without a usable pose or time
    probe: ConvexProbe

    @property
    def lowest(self) -> float:
        """The least correlation of any frame as it was recorded."""
        return min(row.ncc_raw for row in self.rows)

    def markdown(self) -> str:
        """Section of the report."""
        probe = self.probe
        rows = []
        for name, words in (
            ("ncc_raw", "the frame as recorded"),
            ("ncc_smoothed", f"it, smoothed by {1e3 * RESOLUTION:g} mm, as the volume is"),
            ("ncc_mirrored", "the smoothed frame, left and right swapped"),
        ):
            ncc = np.array([getattr(row, name) for row in self.rows])
            numbers = (f"{x:.3f}" for x in (ncc.min(), np.median(ncc), ncc.max()))
            rows.append((words, *numbers, f"{(ncc >= 0.8).sum()} of {len(ncc)}"))
        head = ("normalised cross-correlation with", "lowest", "median", "highest", "at least 0.8")
        lateral, elevation, axial = 1e3 * np.abs(self.shifts).max(axis=0)
        return filled(
            "slice",
            "recorded",
            count=f"{len(self.rows)}",
            radius=f"{1e3 * probe.radius:.1f}",
            angle=f"{math.degrees(probe.opening_angle):.1f}",
            depth=f"{1e3 * probe.depth:.0f}",
            columns=f"{probe.columns}",
            rows=f"{probe.rows}",
            spacing=f"{1e3 * probe.pixel_spacing[1]:.3f}",
            margin=f"{1e3 * MARGIN:g}",
            coverage=f"{100 * np.mean([row.coverage for row in self.rows]):.0f}",
            left_out=f"{self.left_out}",
            table=markdown_table(head, rows),
            rigid=f"{max(row.grey_difference_rigid for row in self.rows)}",
            largest=f"{3e3 * SHIFT_STEP:.1f}",
            step=f"{1e3 * SHIFT_STEP:.1f}",
            shifted=f"{len(self.shifts)}",
            lateral=f"{lateral:.1f}",
            axial=f"{axial:.1f}",
            elevation=f"{elevation:.1f}",
            attribution=_ATTRIBUTION,
        )


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
    frames = RecordedPairs(volume, sweep, fan, method)
    chosen = list(range(0, len(sweep.numbers), 10 if quick else 1))
    shown = {chosen[i] for i in np.linspace(0, len(chosen) - 1, 6).round().astype(int)}
    rows, pairs, shifts = [], [], []
    for index, image in zip(chosen, sweep.images(chosen), strict=True):
        pair = frames.pair(sweep, index, image)
        rows.append(frames.compare(pair, float(sweep.times[index])))
        if index in shown:
            pairs.append(pair)
            shifts.append(frames.best_shift(pair))
    out.mkdir(parents=True, exist_ok=True)
    write_rows(out / "recorded_frames.csv", rows)
    _draw_recorded(rows, pairs, frames.probe, out / "recorded_frames.png")
    left_out = sum(sweep.left_out.values())
    return RecordedComparison(rows, np.array(shifts), left_out, frames.probe)
