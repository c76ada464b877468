"""Cross-sections of vessels in the image plane, held against those of the tissue at rest."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import repeat

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from us_sim.geometry.pose import Pose
from us_sim.scoring.centre_line import CentreLine
from us_sim.scoring.metrics import VesselSection
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.probe.probe import lift_probe
from us_sim.tissue.elasticity.material import guess_tissue_kind
from us_sim.volume.volume import Volume

VESSELS = ("vein", "artery")  # kinds of tissue whose cross-sections are measured
_HARDLY_CUT = 0.1
"""Of a vessel's mean cross-section, or else of its largest in an image at rest: less of it is its
edge, or cut off by the image."""


def find_lumen_labels(label_names: Mapping[int, str]) -> dict[str, tuple[int, ...]]:
    """Return the labels inside each vessel, veins first; ``vein thrombus`` fills part of ``vein``.

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
    """Return the vessels' centre lines, and the places (from, to) m of thrombi along them.

    Both are by the vessels' names. A short vessel has neither.
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
            along = line.find_arc_lengths(volume.compute_centres(clot))
            thrombi[name] = float(along.min()), float(along.max())
    return lines, thrombi


class LumenMeter:
    """Measures vessels image by image.

    Where the probe slides or tilts it sees other cross-sections, so each is compared with that of
    the same plane at rest, from the skin on. An area at rest is NaN where the two cannot be
    compared: the plane hardly cuts the vessel, or the vessel reaches the image's edge, now or at
    rest, or it vanishes right before or after a sample in which it does.

    Args:
        lumens: labels of each vessel by its name.
        scanner: that finds labels.
        rest: (N, 3) m, nodes of the mesh that the scanner carries; None where it carries none.
        lines: centre lines by the vessels' names.
    """

    def __init__(
        self,
        lumens: Mapping[str, tuple[int, ...]],
        scanner: BMode,
        rest: NDArray[np.float64] | None = None,
        lines: Mapping[str, CentreLine] | None = None,
    ) -> None:
        self._lumens, self._scanner, self._rest = lumens, scanner, rest
        self._lines = {name: (lines or {}).get(name) for name in lumens}
        typical = [0.0 if line is None else line.area for line in self._lines.values()]
        self._typical = np.array(typical).reshape(-1, 1)  # m²
        self._pixel = float(np.prod(scanner.probe.pixel_spacing))
        reached = np.pad(np.isfinite(scanner.probe.pixel_beams[0]), 1)
        # the last pixels (rows, columns) of an image that its beams reach
        self._edge = (reached & ~binary_erosion(reached))[1:-1, 1:-1]
        self.times: list[float] = []  # s, of all samples
        self._depths: list[float] = []  # m, of the probe below the skin
        self._cuts: list[list[tuple[float, float]]] = []  # m along and lateral, by vessel
        self._areas: list[list[list[float]]] = []  # m², now and at rest, by vessel
        self._is_whole: list[NDArray[np.bool_]] = []  # in the image, by vessel

    def add_image(self, time: float, pose: Pose, labels: NDArray[np.uint8]) -> None:
        """Measure an image, of the labels (rows, columns) that it shows."""
        above, width = lift_probe(pose), self._scanner.probe.width
        seen = labels, self._scanner.render_labels(above, self._rest)
        inside = [[np.isin(each, n) for n in self._lumens.values()] for each in seen]
        cuts = [line and line.find_cut(above, width) for line in self._lines.values()]
        self.times.append(time)
        self._depths.append(float(pose.position[2]))
        self._cuts.append([cut or (np.nan, np.nan) for cut in cuts])
        self._areas.append([[self._pixel * float(v.sum()) for v in each] for each in inside])
        self._is_whole.append(~np.any([[v[self._edge].any() for v in each] for each in inside], 0))

    def collect_comparable_sections(self) -> dict[str, VesselSection]:
        """Return the sections of the vessels of which an image can be compared with rest."""
        sections = self.collect_sections()
        return {n: each for n, each in sections.items() if np.isfinite(each.at_rest).any()}

    def collect_sections(self, span: slice = slice(None)) -> dict[str, VesselSection]:
        """Return the sections of these samples by the vessels' names; none without a sample."""
        times = np.array(self.times[span])
        if not len(times):
            return {}
        now, rest = np.array(self._areas[span]).transpose(1, 2, 0)  # by vessel and sample
        along, lateral = np.array(self._cuts[span]).transpose(2, 1, 0)
        whole, last = np.array(self._is_whole[span]).T.copy(), len(times) - 1
        is_gone = (now == 0.0) & (rest > 0.0)  # pushed out, maybe not closed
        for k in [*range(1, last + 1), *range(last - 1, -1, -1)]:
            for beside in {max(k - 1, 0), min(k + 1, last)}:
                whole[:, k] &= whole[:, beside] | ~is_gone[:, k]
        typical = np.where(self._typical > 0, self._typical, rest.max(axis=1, keepdims=True))
        rest = np.where((rest <= _HARDLY_CUT * typical) | ~whole, np.nan, rest)
        depths = np.array(self._depths[span])
        sections = map(VesselSection, repeat(times), now, rest, along, lateral, repeat(depths))
        return dict(zip(self._lumens, sections, strict=True))

    def is_settled(self, sample: int) -> bool:
        """Return whether later samples change nothing of this one and those before."""
        now, rest = self._areas[sample]
        return not any(n == 0.0 and r > 0.0 for n, r in zip(now, rest, strict=True))
