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
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.resampling import sample_plane
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import ConvexProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.files.readers import read_volume
from us_sim.volume.reconstruction.reconstruction import correlation
from us_sim.volume.sequences.sweep import Sweep, read_sweep
from us_sim.volume.volume import Volume


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

    def compare(self, pair: RecordedPair, time: float) -> dict[str, Any]:
        """Row of how like the two are: smoothed to the volume's resolution, and mirrored, too."""
        plane = self.probe.plane(pair.pose)
        shown = plane.is_shown()
        rigid = np.where(shown, sample_plane(self.volume, plane), np.uint8(0))
        smoothed = self._smoothed(pair.recorded, RESOLUTION)
        compared, simulated = pair.compared, pair.simulated
        both = compared & compared[:, ::-1]
        return {
            "frame": pair.frame,
            "time": time,
            "coverage": float(compared.sum() / shown.sum()),  # of the fan
            "ncc_raw": normalised_cross_correlation(pair.recorded, simulated, compared),
            "ncc_smoothed": normalised_cross_correlation(smoothed, simulated, compared),
            "ncc_mirrored": normalised_cross_correlation(smoothed, simulated[:, ::-1], both),
            "grey_difference_rigid": int(np.abs(simulated.astype(np.int16) - rigid).max()),
        }

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


def recorded_rows(
    volume_file: Path,
    sweep_file: Path,
    quick: bool,
    *,
    fan: RecordedFan = LIVER_SWEEP,
    method: str = "scan_conversion",
) -> Iterator[dict[str, Any]]:
    """Compare the frames of a sweep (quick: every tenth) with the volume made from them.

    Six of the rows also hold the pair.

    Args:
        volume_file: compounded from the sweep.
        sweep_file: with tracked images.
        quick: see above.
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
    for index, image in zip(chosen, sweep.images(chosen), strict=True):
        pair = frames.pair(sweep, index, image)
        row = frames.compare(pair, float(sweep.times[index]))
        if index in shown:
            row["pair"] = pair
        yield row
