"""Rows of image.csv, the interface of artefacts, and layers of tissue with their known loss.

>>> from us_sim.evaluation.image.measure import Point, lost
>>> Point.of("attenuation", "linear", 20.0, 0.01, -6.0, -6.1, "dB").error_percent.__round__(2)
-1.14
>>> Point.of("strain", "linear", 0.0, 0.02, 0.04, 0.0404, "").error_percent.__round__(2)
1.0
>>> down = np.array([0.0, 0.0, 1.0])
>>> float(lost(np.zeros(3), down, np.array([0.01]), 5e6)[0].round(3))  # 1 cm of liver
-4.5
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.report import ReportFolder, Row, Target
from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.settings import TissueAcoustics
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Point(Row):
    """One expected number, and the one that the image shows."""

    artefact: str
    probe: str
    tilt_deg: float = float("nan")
    depth_mm: float = float("nan")
    expected: float = float("nan")
    measured: float = float("nan")
    unit: str = ""
    error_percent: float = float("nan")
    ms_median: float = float("nan")  # processor time of an image, where that was measured
    failure: str = ""

    @classmethod
    def of(
        cls,
        artefact: str,
        probe: str,
        tilt: float,
        depth: float,
        expected: float,
        measured: float,
        unit: str,
        *,
        of: float | None = None,
        ms: float = float("nan"),
    ) -> Point:
        """A row; the error of levels in dB is that of the amplitude.

        Args:
            tilt: degrees. depth: m.
            of: whole of which the error is a fraction; None is the expected value, of pixels one.
        """
        if unit == "dB":
            error = 100.0 * (10.0 ** ((measured - expected) / 20.0) - 1.0)
        else:
            whole = of or (1.0 if unit == "px" else abs(expected))
            error = 100.0 * (measured - expected) / whole if whole else float("nan")
        return cls(artefact, probe, tilt, 1e3 * depth, expected, measured, unit, error, ms)

    @property
    def title(self) -> str:
        return f"{self.artefact}, {self.probe}, {self.tilt_deg:g}°"


class Artefact(ABC):
    """An effect in images that is measured; `us_sim.evaluation.image.report` lists them."""

    name: ClassVar[str]  # the first column of its rows: a word, or several with underscores
    title: ClassVar[str]  # the heading of its part of the report

    @abstractmethod
    def points(self, quick: bool) -> list[Point]:
        """The rows of image.csv."""

    @abstractmethod
    def targets(self, points: Sequence[Point]) -> list[Target]:
        """Limits against its own rows."""

    @abstractmethod
    def report(self, points: Sequence[Point], folder: ReportFolder) -> str:
        """Its part of the report, from its template; draws its pictures into the folder."""


def worst_percent(points: Sequence[Point]) -> float:
    """The greatest error."""
    return max(abs(p.error_percent) for p in points)


@dataclass(frozen=True)
class Layer:
    """A tissue from one depth on to where the next one begins."""

    name: str
    begin: float  # m, along z of ``patient``
    attenuation: float  # dB/cm/MHz
    impedance: float  # Rayl

    @property
    def tissue(self) -> TissueAcoustics:
        """Its constants as settings."""
        return TissueAcoustics(attenuation=self.attenuation, impedance=self.impedance)


LAYERS = (
    Layer("liver", -np.inf, 0.45, 1.657e6),
    Layer("fat", 0.0124, 0.6, 1.327e6),
    Layer("blood", 0.0213, 0.14, 1.679e6),
    Layer("muscle", 0.0301, 0.9, 1.645e6),
)

PROBES: dict[str, Probe] = {
    "linear": LinearProbe(aperture=0.04, depth=0.045),
    "convex": ConvexProbe(radius=0.05, opening_angle=np.radians(60), depth=0.07),
    "sector": SectorProbe(aperture=0.02, opening_angle=np.radians(80), depth=0.07),
}

GREY = 170  # of all voxels


def voxel_grid(
    extent: Sequence[tuple[float, float]], voxel: Sequence[float]
) -> tuple[list[int], Array]:
    """Counts of voxels (m) that fill an extent (m), and the matrix from indices to ``patient``."""
    counts = [round((high - low) / step) for (low, high), step in zip(extent, voxel, strict=True)]
    to_patient = np.diag([*voxel, 1.0])
    to_patient[:3, 3] = [low + 0.5 * step for (low, _), step in zip(extent, voxel, strict=True)]
    return counts, to_patient


def layered_volume() -> Volume:
    """The layers, with a border of theirs on a border of voxels; nothing changes along x and y."""
    voxel = (4e-3, 4e-3, 0.1e-3)
    counts, to_patient = voxel_grid(((-0.16, 0.16), (-0.16, 0.16), (-0.06, 0.11)), voxel)
    z = to_patient[2, 3] + voxel[2] * np.arange(counts[2])
    labels = np.empty(counts, dtype=np.uint8)
    labels[:] = np.searchsorted([layer.begin for layer in LAYERS], z)
    names = {number: layer.name for number, layer in enumerate(LAYERS, 1)}
    return Volume(np.full(counts, GREY, dtype=np.uint8), to_patient, labels, names)


def lost(start: Array, direction: Array, distance: Array, frequency: float) -> Array:
    """dB by which echoes at distances (…,) m along beams are changed (Beer and Lambert).

    Args:
        start, direction: (…, 3) m and unit, in ``patient``. frequency: Hz.
    """
    z = start[..., 2]
    slope = direction[..., 2]
    end = z + slope * distance
    upper, lower = np.minimum(z, end), np.maximum(z, end)
    # Where a beam runs along the layers all of it is in one.
    per_depth = np.abs(np.divide(distance, end - z, out=np.zeros_like(end), where=end != z))
    level = np.zeros_like(end)
    begins = [layer.begin for layer in LAYERS] + [np.inf]
    for number, layer in enumerate(LAYERS):
        top, bottom = np.maximum(upper, layer.begin), np.minimum(lower, begins[number + 1])
        within = np.clip(bottom - top, 0, None) * per_depth
        level -= 2.0 * 100.0 * layer.attenuation * frequency * 1e-6 * within
        if number:
            above = LAYERS[number - 1].impedance
            ratio = (layer.impedance - above) / (layer.impedance + above)
            passed = (upper < layer.begin) & (lower >= layer.begin)
            level += 20.0 * np.log10(1.0 - ratio**2) * passed
    return level


def tilted(degrees: float, *, elevational: bool = False) -> Pose:
    """A probe at the origin, turned about y in its image's plane, or about x out of it."""
    half = 0.5 * np.radians(degrees)
    axis = (np.sin(half), 0.0, 0.0) if elevational else (0.0, np.sin(half), 0.0)
    return Pose(np.zeros(3), np.array([*axis, np.cos(half)]))
