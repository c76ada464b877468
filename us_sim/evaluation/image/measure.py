"""Rows of image.csv, and layers of tissue with their known loss.

>>> from us_sim.evaluation.image.measure import row_of, lost
>>> round(row_of("attenuation", "linear", 20.0, 0.01, -6.0, -6.1, "dB")["error_percent"], 2)
-1.14
>>> down = np.array([0.0, 0.0, 1.0])
>>> float(lost(np.zeros(3), down, np.array([0.01]), 5e6)[0].round(3))  # 1 cm of liver
-4.5
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]


def row_of(
    artefact: str,
    probe: str,
    tilt: float,
    depth: float,
    expected: float,
    measured: float,
    unit: str,
) -> dict[str, Any]:
    """Row of one expected number, and the one that the image shows.

    Args:
        artefact: a word, or several with underscores.
        tilt: degrees. depth: m.
        unit: the error of levels in dB is that of the amplitude, of pixels in hundredths of one.
    """
    if unit == "dB":
        error = 100.0 * (10.0 ** ((measured - expected) / 20.0) - 1.0)
    else:
        whole = 1.0 if unit == "px" else abs(expected)
        error = 100.0 * (measured - expected) / whole if whole else float("nan")
    return {
        "artefact": artefact,
        "probe": probe,
        "tilt_deg": tilt,
        "depth_mm": 1e3 * depth,
        "expected": expected,
        "measured": measured,
        "unit": unit,
        "error_percent": error,
    }


@dataclass(frozen=True)
class Layer:
    """A tissue from one depth on to where the next one begins."""

    name: str
    begin: float  # m, along z of ``patient``
    attenuation: float  # dB/cm/MHz
    impedance: float  # Rayl


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
