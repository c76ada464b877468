"""Cross-sections of vessels in the image plane, held against those of the tissue at rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from us_sim.geometry.pose import Pose
from us_sim.scoring.centre_line import CentreLine, places_of
from us_sim.scoring.metrics import Force, Scan, Section
from us_sim.scoring.motion import Motion
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.probe.probe import Probe
from us_sim.tissue.elasticity.material import kind_of
from us_sim.volume.volume import Volume

VESSELS = ("vein", "artery")  # kinds of tissue whose cross-sections are measured
_HARDLY_CUT = 0.1
"""Of a vessel's largest cross-section at rest: less of it is its edge, or cut off by the image."""
_STEEPEST = 0.2
"""Cosine of a probe's tilt; beyond it, how far it would have to be lifted means nothing."""


def lumens_of(label_names: Mapping[int, str]) -> dict[str, tuple[int, ...]]:
    """Labels of the inside of each vessel, veins first; a ``vein thrombus`` fills part of ``vein``.

    >>> lumens_of({5: "artery", 6: "vein", 8: "vein thrombus"})
    {'vein': (6, 8), 'artery': (5,)}
    """
    labels = {name: label for label, name in label_names.items()}
    return {
        name: tuple(labels[part] for part in (name, f"{name} thrombus") if part in labels)
        for kind in VESSELS
        for name in labels
        if kind_of(name) == kind
    }


def vessels_in(volume: Volume) -> tuple[dict[str, CentreLine], dict[str, tuple[float, float]]]:
    """Centre lines of vessels by their names, and where along them a thrombus is (m, from, to).

    A vessel that is not long has none.
    """
    lines: dict[str, CentreLine] = {}
    thrombi: dict[str, tuple[float, float]] = {}
    if volume.labels is None:
        return lines, thrombi
    for name, numbers in lumens_of(volume.label_names).items():
        line = CentreLine.of(volume, np.isin(volume.labels, numbers))
        if line is None:
            continue
        lines[name] = line
        if len(numbers) > 1:
            along = line.along(places_of(volume, np.isin(volume.labels, numbers[1])))
            thrombi[name] = float(along.min()), float(along.max())
    return lines, thrombi


@dataclass(frozen=True)
class LumenAreas:
    """Cross-sections of vessels in the image plane."""

    time: NDArray[np.float64]  # (K,) s since the first pose
    depth: NDArray[np.float64]  # (K,) m, how deep the probe is pressed below the skin
    area: dict[str, NDArray[np.float64]]  # (K,) m² by vessel
    # (K,) m² by vessel, in the same planes of the tissue at rest; NaN where it is hardly cut
    at_rest: dict[str, NDArray[np.float64]]

    @property
    def pressed(self) -> int:
        """The first sample within 1 % of the deepest press."""
        return int(np.argmax(self.depth >= 0.99 * self.depth.max()))

    def fraction(self, vessel: str) -> NDArray[np.float64]:
        """(K,) area over that of the same plane at rest; NaN where there is nothing to compare."""
        return np.asarray(self.area[vessel] / self.at_rest[vessel])

    def change(self, vessel: str, sample: int) -> float:
        """Relative change of the area from rest; -0.5 is half closed."""
        return float(self.fraction(vessel)[sample] - 1.0)

    def sections(
        self, poses: Sequence[Pose], lines: Mapping[str, CentreLine], width: float
    ) -> dict[str, Section]:
        """The same, with their places along the vessels that have a centre line.

        Args:
            poses: (K,) of the probe.
            width: m, of the image.
        """
        found: dict[str, Section] = {}
        for name in self.area.keys() & lines.keys():
            cuts = [lines[name].cut(_lifted(pose), width) for pose in poses]
            places = [(c.along, c.angle, c.lateral) if c else (np.nan,) * 3 for c in cuts]
            found[name] = Section(
                self.time, self.area[name], self.at_rest[name], *np.array(places).T
            )
        return {name: found[name] for name in lines if name in found}


class LumenMeter:
    """Measures vessels image by image.

    Where the probe slides or tilts it sees other cross-sections, so each is compared with that of
    the same plane at rest, from the skin on. A vessel that no image cuts has none; of one that
    reaches the image's edge, now or at rest, nobody knows how large it is.

    Args:
        lumens: labels of each vessel by its name.
        scanner: that finds labels.
        rest: (N, 3) m, nodes of the mesh that the scanner carries; None where it carries none.
    """

    def __init__(
        self,
        lumens: Mapping[str, tuple[int, ...]],
        scanner: BMode,
        rest: NDArray[np.float64] | None = None,
    ) -> None:
        self._lumens, self._scanner, self._rest = lumens, scanner, rest
        self._pixel = float(np.prod(scanner.probe.pixel_spacing))
        self._edge = _edge(scanner.probe)
        self._time: list[float] = []
        self.poses: list[Pose] = []
        self._found: list[list[list[float]]] = []  # m², now and at rest, by vessel
        self._whole: list[NDArray[np.bool_]] = []  # in the image, by vessel

    def add(self, time: float, pose: Pose, labels: NDArray[np.uint8]) -> None:
        """Measure an image, of the labels (rows, columns) that it shows."""
        seen = labels, self._scanner.labels(_lifted(pose), self._rest)
        inside = [[np.isin(each, n) for n in self._lumens.values()] for each in seen]
        self._time.append(time)
        self.poses.append(pose)
        self._found.append([[self._pixel * float(v.sum()) for v in each] for each in inside])
        self._whole.append(~np.any([[v[self._edge].any() for v in each] for each in inside], 0))

    def areas(self) -> LumenAreas | None:
        """All that were measured; None where no vessel was cut that can be compared."""
        if not self._time:
            return None
        now, rest = np.array(self._found).transpose(1, 2, 0)
        whole, count = np.array(self._whole).T.copy(), len(self._time)
        for k in [*range(1, count), *range(count - 2, -1, -1)]:
            for beside in {max(k - 1, 0), min(k + 1, count - 1)}:
                whole[:, k] &= whole[:, beside] | (now[:, k] > 0.0)  # pushed out, maybe not closed
        hardly = rest <= _HARDLY_CUT * rest.max(axis=1, keepdims=True)
        rest = np.where(hardly | ~whole, np.nan, rest)
        cut = {n: i for i, n in enumerate(self._lumens) if np.isfinite(rest[i]).any()}
        if not cut:
            return None
        return LumenAreas(
            time=np.array(self._time),
            depth=np.array([pose.position[2] for pose in self.poses]),
            area={name: now[i] for name, i in cut.items()},
            at_rest={name: rest[i] for name, i in cut.items()},
        )


def _edge(probe: Probe) -> NDArray[np.bool_]:
    """(rows, columns) the last pixels of an image that its beams reach."""
    reached = np.pad(np.isfinite(probe.pixel_beams[0]), 1)
    return np.asarray((reached & ~binary_erosion(reached))[1:-1, 1:-1])


def _lifted(pose: Pose) -> Pose:
    """Where the probe would be in the same plane if it did not press."""
    depth = max(float(pose.position[2]), 0.0) / max(float(pose.rotation[2, 2]), _STEEPEST)
    return Pose(pose.position - depth * pose.rotation[:, 2], pose.orientation)


class LiveScan:
    """A scan that grows while it is done.

    Args:
        volume: whose vessels are measured, where it has labels.
        scanner: of that volume at rest, with the probe that scans.
    """

    def __init__(self, volume: Volume, scanner: BMode) -> None:
        self.lines, self._thrombi = vessels_in(volume)
        self._lumens = lumens_of(volume.label_names) if self.lines else {}
        self._scanner = scanner
        self.clear()

    def clear(self) -> None:
        """Begin anew."""
        self._poses: list[tuple[float, Pose]] = []
        self._forces: list[tuple[float, float]] = []
        self._meter = LumenMeter(self._lumens, self._scanner)

    def add_pose(self, time: float, pose: Pose) -> None:
        """Take a pose of the probe at a time (s) after those before; others are passed over."""
        if not self._poses or time > self._poses[-1][0]:
            self._poses.append((time, pose))

    def add_force(self, time: float, newtons: float) -> None:
        """Take the magnitude of the force on the probe, likewise."""
        if not self._forces or time > self._forces[-1][0]:
            self._forces.append((time, newtons))

    def add_labels(self, time: float, pose: Pose, labels: NDArray[np.uint8]) -> None:
        """Take the labels (rows, columns) of an image."""
        if self._lumens:
            self._meter.add(time, pose, labels)

    def scan(self) -> Scan | None:
        """All so far; None before there is a motion."""
        if len(self._poses) < 2:
            return None
        times, poses = zip(*self._poses, strict=True)
        positions, orientations = zip(*((p.position, p.orientation) for p in poses), strict=True)
        motion = Motion(np.array(times), np.array(positions), np.array(orientations))
        force = Force(*np.array(self._forces).T) if len(self._forces) > 1 else None
        areas = self._meter.areas()
        width = self._scanner.probe.width
        sections = areas.sections(self._meter.poses, self.lines, width) if areas else {}
        return Scan(motion, force, sections, self.lines, self._thrombi, width)
