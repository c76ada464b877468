"""Cross-sections of vessels in the image plane, held against those of the tissue at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from us_sim.geometry.pose import Pose
from us_sim.scoring.centre_line import CentreLine, compute_voxel_centres
from us_sim.scoring.metrics import VesselSection
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.probe.probe import Probe
from us_sim.tissue.elasticity.material import guess_tissue_kind
from us_sim.volume.volume import Volume

VESSELS = ("vein", "artery")  # kinds of tissue whose cross-sections are measured
_HARDLY_CUT = 0.1
"""Of a vessel's mean cross-section, or else of its largest in an image at rest: less of it is its
edge, or cut off by the image."""
_STEEPEST = 0.2
"""Cosine of a probe's tilt; beyond it, how far it would have to be lifted means nothing."""


def lift_probe(pose: Pose) -> Pose:
    """Lift a probe within its image plane until it does not press into z > 0."""
    depth = max(float(pose.position[2]), 0.0) / max(float(pose.rotation[2, 2]), _STEEPEST)
    return Pose(pose.position - depth * pose.rotation[:, 2], pose.orientation)


def find_lumen_labels(label_names: Mapping[int, str]) -> dict[str, tuple[int, ...]]:
    """Labels of the inside of each vessel, veins first; a ``vein thrombus`` fills part of ``vein``.

    >>> find_lumen_labels({5: "artery", 6: "vein", 8: "vein thrombus"})
    {'vein': (6, 8), 'artery': (5,)}
    """
    labels = {name: label for label, name in label_names.items()}
    return {
        name: tuple(labels[part] for part in (name, f"{name} thrombus") if part in labels)
        for kind in VESSELS
        for name in labels
        if guess_tissue_kind(name) == kind
    }


def find_vessels(volume: Volume) -> tuple[dict[str, CentreLine], dict[str, tuple[float, float]]]:
    """Centre lines of vessels by their names, and where along them a thrombus is (m, from, to).

    A vessel that is not long has none.
    """
    lines: dict[str, CentreLine] = {}
    thrombi: dict[str, tuple[float, float]] = {}
    if volume.labels is None:
        return lines, thrombi
    for name, numbers in find_lumen_labels(volume.label_names).items():
        line = CentreLine.from_labels(volume, np.isin(volume.labels, numbers))
        if line is None:
            continue
        lines[name] = line
        clot = np.isin(volume.labels, numbers[1:])
        if clot.any():
            along = line.find_arc_lengths(compute_voxel_centres(volume, clot))
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

    def compute_fraction(self, vessel: str) -> NDArray[np.float64]:
        """(K,) area over that of the same plane at rest; NaN where there is nothing to compare."""
        return np.asarray(self.area[vessel] / self.at_rest[vessel])


class LumenMeter:
    """Measures vessels image by image.

    Where the probe slides or tilts it sees other cross-sections, so each is compared with that of
    the same plane at rest, from the skin on. A vessel that no image cuts has none; of one that
    reaches the image's edge, now or at rest, nobody knows how large it is, nor of one that vanishes
    from the image just before or after.

    Args:
        lumens: labels of each vessel by its name.
        scanner: that finds labels.
        rest: (N, 3) m, nodes of the mesh that the scanner carries; None where it carries none.
        lines: centre lines by the vessels' names, for `collect_sections`.
    """

    def __init__(
        self,
        lumens: Mapping[str, tuple[int, ...]],
        scanner: BMode,
        rest: NDArray[np.float64] | None = None,
        lines: Mapping[str, CentreLine] | None = None,
    ) -> None:
        self._lumens, self._scanner, self._rest = lumens, scanner, rest
        self._lines = lines or {}
        typical = [self._lines[name].area if name in self._lines else 0.0 for name in lumens]
        self._typical = np.array(typical).reshape(-1, 1)  # m²
        self._pixel = float(np.prod(scanner.probe.pixel_spacing))
        self._edge = _edge(scanner.probe)
        self.times: list[float] = []  # s, of all samples
        self._depth: list[float] = []
        self._cuts: dict[str, list[tuple[float, ...]]] = {name: [] for name in self._lines}
        self._found: list[list[list[float]]] = []  # m², now and at rest, by vessel
        self._whole: list[NDArray[np.bool_]] = []  # in the image, by vessel

    def add_image(self, time: float, pose: Pose, labels: NDArray[np.uint8]) -> None:
        """Measure an image, of the labels (rows, columns) that it shows."""
        above = lift_probe(pose)
        seen = labels, self._scanner.render_labels(above, self._rest)
        inside = [[np.isin(each, n) for n in self._lumens.values()] for each in seen]
        self.times.append(time)
        self._depth.append(float(pose.position[2]))
        for name, line in self._lines.items():
            cut = line.find_cut(above, self._scanner.probe.width)
            place = (cut.along, cut.angle, cut.lateral) if cut else (np.nan,) * 3
            self._cuts[name].append(place)
        self._found.append([[self._pixel * float(v.sum()) for v in each] for each in inside])
        self._whole.append(~np.any([[v[self._edge].any() for v in each] for each in inside], 0))

    def collect_areas(self) -> LumenAreas | None:
        """All that were measured; None where no vessel was cut that can be compared."""
        if not self.times:
            return None
        now, rest = self._compared()
        cut = {n: i for i, n in enumerate(self._lumens) if np.isfinite(rest[i]).any()}
        if not cut:
            return None
        return LumenAreas(
            time=np.array(self.times),
            depth=np.array(self._depth),
            area={name: now[i] for name, i in cut.items()},
            at_rest={name: rest[i] for name, i in cut.items()},
        )

    def _compared(
        self, begin: int = 0, end: int | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Areas (V, K) m² of these samples, and those at rest, NaN where nobody knows them."""
        now, rest = np.array(self._found[begin:end]).transpose(1, 2, 0)
        whole, count = np.array(self._whole[begin:end]).T.copy(), now.shape[1]
        is_gone = (now == 0.0) & (rest > 0.0)  # pushed out, maybe not closed
        for k in [*range(1, count), *range(count - 2, -1, -1)]:
            for beside in {max(k - 1, 0), min(k + 1, count - 1)}:
                whole[:, k] &= whole[:, beside] | ~is_gone[:, k]
        typical = np.where(self._typical > 0, self._typical, rest.max(axis=1, keepdims=True))
        return now, np.where((rest <= _HARDLY_CUT * typical) | ~whole, np.nan, rest)

    def is_settled(self, sample: int) -> bool:
        """Whether later samples change nothing of this one and those before."""
        now, rest = self._found[sample]
        return not any(n == 0.0 and r > 0.0 for n, r in zip(now, rest, strict=True))

    def collect_sections(self, begin: int = 0, end: int | None = None) -> dict[str, VesselSection]:
        """Areas and places of the vessels that have a centre line, of these samples."""
        times = np.array(self.times[begin:end])
        if not len(times):
            return {}
        areas = dict(zip(self._lumens, zip(*self._compared(begin, end), strict=True), strict=True))
        return {
            name: VesselSection(times, *areas[name], *np.array(cuts[begin:end]).T)
            for name, cuts in self._cuts.items()
        }


def _edge(probe: Probe) -> NDArray[np.bool_]:
    """(rows, columns) the last pixels of an image that its beams reach."""
    reached = np.pad(np.isfinite(probe.pixel_beams[0]), 1)
    return np.asarray((reached & ~binary_erosion(reached))[1:-1, 1:-1])
