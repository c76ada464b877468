"""A recorded frame and the image simulated at its pose, on the same pixels, and how alike they are.

>>> import numpy as np
>>> from us_sim.evaluation.slice.recorded_pairs import normalised_cross_correlation
>>> image = np.array([[1.0, 2.0], [3.0, 9.0]])
>>> everywhere = np.ones((2, 2), dtype=bool)
>>> round(normalised_cross_correlation(image, 5.0 - 2.0 * image, everywhere), 12)
-1.0
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.evaluation.row import Row
from us_sim.evaluation.slice.recorded_fan import RecordedFan
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.resampling import sample_plane
from us_sim.slicing.cutting.slicer import Slicer, create_slicer
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import ConvexProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.sequences.sweep import Sweep
from us_sim.volume.volume import Volume

RESOLUTION = 1e-3
"""m, standard deviation of the Gaussian that smooths a frame to its volume's resolution."""

MARGIN = 2e-3
"""m, from the border of what the sweep covered; nearer, few frames were averaged, so that pixels
are not compared."""

SHIFT_STEP = 0.63e-3
"""m, between the shifts that are tried; about two pixels of the liver sweep."""

LARGEST_SHIFT = 3 * SHIFT_STEP

_SHIFTS = SHIFT_STEP * np.arange(-3, 4)
_COARSE = 5e-3  # m, standard deviation of the Gaussian that leaves no structures
_MESH = (24, 20, 16)  # nodes along each axis of the tissue around the volume


@dataclass(frozen=True)
class RecordedFrame(Row):
    """How like a recorded frame its simulated image is; a row of recorded_frames.csv."""

    digits = 6

    frame: int
    time: float  # s
    coverage: float  # fraction of the fan in which the two are compared
    ncc_raw: float  # normalised cross-correlation with the frame as it was recorded
    ncc_smoothed: float  # with the frame smoothed to the volume's resolution
    ncc_mirrored: float  # smoothed, left and right swapped: what a wrong image reaches
    grey_difference_rigid: int  # largest, between tissue at rest and the volume without tissue


@dataclass(frozen=True, eq=False)
class RecordedPair:
    """A recorded frame and its simulated image, on the same pixels."""

    frame: int
    pose: Pose  # of the probe, in the sweep's frame
    recorded: NDArray[np.uint8]  # (rows, columns)
    simulated: NDArray[np.uint8]  # (rows, columns)
    compared: NDArray[np.bool_]  # (rows, columns), where both hold the tissue


@dataclass(frozen=True, eq=False)
class RecordedPairs:
    """Makes and compares the pairs of one sweep."""

    volume: Volume
    support: Volume  # 255 where the volume holds something
    fan: RecordedFan
    spacing: float  # m, of the recorded pixels
    probe: ConvexProbe
    slicer: Slicer
    nodes: NDArray[np.float64]  # (N, 3) m, of the tissue at rest

    @classmethod
    def of(cls, volume: Volume, sweep: Sweep, fan: RecordedFan, method: str) -> RecordedPairs:
        """A box of tissue around the volume, and the probe that took the sweep.

        Raises:
            VolumeError: the sweep's images are of another kind than the fan's.
        """
        steps = sweep.image_to_reference[:, :3, :2]
        sizes = np.linalg.norm(steps, axis=1)
        spacing = float(sizes.mean())
        slant = np.einsum("ki,ki->k", steps[:, :, 0], steps[:, :, 1]) / spacing**2
        if max(np.abs(sizes / spacing - 1.0).max(), np.abs(slant).max()) > 1e-3:
            raise VolumeError(
                f"{sweep.path}: its pixels are not squares of one size ({1e3 * sizes.min():g} to "
                f"{1e3 * sizes.max():g} mm); give a sweep that was taken at one depth"
            )
        if not fan.fits(sweep.columns, sweep.rows):
            raise VolumeError(
                f"{sweep.path}: its images of {sweep.columns} × {sweep.rows} pixels do not hold "
                f"the probe's fan; give the sweep that this fan belongs to"
            )
        mesh = box_mesh(
            *(uniform_planes(a, b, n) for a, b, n in zip(*volume.extent, _MESH, strict=True))
        )
        support = np.where(volume.intensities > 0, np.uint8(255), np.uint8(0))
        return cls(
            volume,
            Volume(support, volume.index_to_patient),
            fan,
            spacing,
            fan.probe(spacing),
            create_slicer(method, volume, mesh.nodes, mesh.tetrahedra),
            mesh.nodes,
        )

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

        Judged by structures of 1 to 5 mm, since what is larger hardly minds a shift.
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
        """(rows, columns): in the fan, and not near the border of what the sweep covers."""
        covered = (sample_plane(self.support, plane) == 255) & plane.is_shown()
        width = 2 * round(MARGIN / self.spacing) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        # The image's own border is one too, which is not what erosion does unasked.
        eroded = cv2.erode(
            covered.astype(np.uint8), disc, borderType=cv2.BORDER_CONSTANT, borderValue=0
        )
        return np.asarray(eroded, dtype=np.bool_)

    def _structures(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        return self._smoothed(image, RESOLUTION) - self._smoothed(image, _COARSE)

    def _smoothed(self, image: NDArray[np.uint8], width: float) -> NDArray[np.float32]:
        """By a Gaussian of that standard deviation, m."""
        pixels = width / self.spacing
        blurred = cv2.GaussianBlur(image.astype(np.float32), (0, 0), pixels)
        return np.asarray(blurred, dtype=np.float32)


def normalised_cross_correlation(
    a: NDArray[np.generic], b: NDArray[np.generic], where: NDArray[np.bool_]
) -> float:
    """Pearson's correlation of two images over some of their pixels; NaN where one is constant."""
    first, second = a[where].astype(np.float64), b[where].astype(np.float64)
    if first.size < 2:
        return math.nan
    first -= first.mean()
    second -= second.mean()
    scale = math.sqrt(float(first @ first) * float(second @ second))
    return float(first @ second) / scale if scale else math.nan
