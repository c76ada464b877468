"""A vessel's centre line, found from the labels of a volume, and its cut with an image plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from us_sim.geometry.pose import Pose
from us_sim.volume.volume import Volume

_PIECE = 2e-3  # m, of the vessel's length, whose voxels give one point of the line
_SMOOTHED = 5  # points, over which the line is straightened: a surface of voxels is uneven


@dataclass(frozen=True)
class CentreLine:
    """A line through the middle of a vessel that does not turn back."""

    points: NDArray[np.float64]  # (P, 3) m, in frame ``patient``; P at least 2
    area: float = 0.0  # m², mean cross-section of the vessel

    @classmethod
    def from_labels(cls, volume: Volume, labels: NDArray[np.bool_]) -> CentreLine | None:
        """Make the line of a volume's marked voxels (i, j, k); None of a structure that is short.

        The voxels are cut across their longest axis, and each piece of 2 mm gives its centroid.
        """
        places = volume.compute_centres(labels)
        if len(places) < 2:
            return None
        middle = places.mean(axis=0)
        axis = np.linalg.svd(np.cov((places - middle).T))[0][:, 0]
        axis *= np.sign(axis[np.argmax(np.abs(axis))])
        along = (places - middle) @ axis
        pieces = np.floor((along - along.min()) / _PIECE).astype(int)
        counts = np.bincount(pieces)
        sums = np.stack([np.bincount(pieces, each) for each in places.T], axis=1)
        points = sums[counts > 0] / counts[counts > 0, None]
        if len(points) < 2 * _SMOOTHED:
            return None
        kernel = np.ones(_SMOOTHED) / _SMOOTHED
        padded = np.pad(points, ((_SMOOTHED // 2,) * 2, (0, 0)), mode="reflect", reflect_type="odd")
        line = cls(np.stack([np.convolve(each, kernel, "valid") for each in padded.T], axis=1))
        size = len(places) * abs(float(np.linalg.det(volume.index_to_patient[:3, :3])))
        return cls(line.points, size / float(line.lengths[-1]))

    @property
    def lengths(self) -> NDArray[np.float64]:
        """(P,) m, the way along the line to each point."""
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def find_arc_lengths(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places (N,) m along the line that are nearest to points (N, 3) m."""
        return np.asarray(self.lengths[cKDTree(self.points).query(points)[1]])

    def interpolate_point(self, along: float) -> NDArray[np.float64]:
        """Interpolate the point (3,) m at a length along the line."""
        lengths = self.lengths
        return np.array([np.interp(along, lengths, each) for each in self.points.T])

    def find_cut(self, pose: Pose, width: float) -> tuple[float, float] | None:
        """Find the cut of the line with a probe's image plane that is nearest below its face.

        Args:
            pose: of the probe, in frame ``patient``.
            width: m, of the image.

        Returns:
            m along the line, and m along the face from its middle; None where it cuts nothing.
        """
        seen = pose.inverse().transform_points(self.points)
        across = seen[:, 1]
        k = np.flatnonzero(across[1:] * across[:-1] <= 0)
        step = across[k] - across[k + 1]
        part = np.divide(across[k], step, out=np.full(len(k), 0.5), where=step != 0)
        x, _, z = (seen[k] + part[:, None] * (seen[k + 1] - seen[k])).T
        below = np.flatnonzero((np.abs(x) <= 0.5 * width) & (z >= 0))
        if not len(below):
            return None
        n = below[np.argmin(z[below])]
        length = np.linalg.norm(self.points[k[n] + 1] - self.points[k[n]])
        return float(self.lengths[k[n]] + part[n] * length), float(x[n])
