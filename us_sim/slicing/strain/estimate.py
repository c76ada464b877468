"""Strain as a scanner estimates it: from nothing but two images of one probe.

>>> import numpy as np
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.strain.estimate import estimate_strain
>>> from us_sim.slicing.strain.settings import Strain
>>> probe = LinearProbe(aperture=0.02, depth=0.03, columns=100, rows=300, lines=100, samples=300)
>>> speckle = np.random.default_rng(0).integers(0, 256, (300, 100)).astype(np.uint8)
>>> same = estimate_strain(speckle, speckle, probe, Strain())
>>> float(abs(np.nan_to_num(same.strain)).max()) < 2e-3, round(same.correlation, 3)
(True, 1.0)
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.strain.least_squares import slope
from us_sim.slicing.strain.settings import Strain
from us_sim.slicing.strain.tracking import track

_STEEPEST = 0.5
"""Of displacement along a beam: what is found steeper than that is not tissue."""


class Estimate(NamedTuple):
    """What two images tell of the tissue's strain between them."""

    strain: NDArray[np.float32]  # (rows, columns), defined as `AxialStrain`'s; NaN where not found
    correlation: float
    """Mean correlation of what was looked for with what was found, 0 to 1; 0 where nothing was.

    Displacement along the beams is compensated, so it falls with what is not: motion across the
    beams and across the image, and strain within windows. It is the first factor of Jiang, Hall
    and Sommer's descriptor of how well strain images come out (Ultrasonic Imaging 28:1, 2006).
    """


def estimate_strain(
    earlier: NDArray[np.uint8], later: NDArray[np.uint8], probe: Probe, settings: Strain
) -> Estimate:
    """Track the earlier image's windows along the beams, and fit lines to their displacement.

    Args:
        earlier, later: (rows, columns) images of the probe.

    Raises:
        ProbeError: a window is longer than half a beam.
    """
    require_short_windows(probe, settings)
    step = probe.depth / probe.samples
    across = _line_spacing(probe)
    window = _odd(settings.window / step), _odd(settings.window / 3.0 / across)
    search = max(1, round(settings.search / step))
    first, second = (_along_beams(image, probe) for image in (earlier, later))
    moved, correlation = track(first, second, window=window, search=search)
    weight = correlation >= max(settings.correlation, 1e-3)
    steep = slope(moved, weight, _odd(settings.fit / step))
    steep[np.abs(steep) > _STEEPEST] = np.nan
    # The place in the earlier image changes by 1 - steep along the beam of the later one.
    strain = steep / (np.float32(1.0) - steep)
    seen = correlation != 0.0
    mean = float(np.maximum(correlation[seen], 0.0).mean()) if seen.any() else 0.0
    return Estimate(_to_pixels(strain, probe), mean)


def require_short_windows(probe: Probe, settings: Strain) -> None:
    """Refuse windows that no beam has room for.

    Raises:
        ProbeError: with both lengths.
    """
    if 2.0 * settings.window > probe.depth:
        raise ProbeError(
            f"strain.window: {1e3 * settings.window:g} mm is more than half of the beams, which "
            f"are {1e3 * probe.depth:g} mm long (depth)"
        )


def _odd(count: float) -> int:
    """The odd whole number nearest to a count, 3 at least."""
    return max(3, 2 * round((count - 1.0) / 2.0) + 1)


def _line_spacing(probe: Probe) -> float:
    """m between beams half way down, on average."""
    if probe.lines < 2:
        return probe.width
    middle = probe.beam_starts + 0.5 * probe.depth * probe.beam_directions
    return float(np.linalg.norm(np.diff(middle, axis=0), axis=1).mean())


def _along_beams(image: NDArray[np.uint8], probe: Probe) -> NDArray[np.float32]:
    """(samples, lines) of an image (rows, columns)."""
    columns, rows = probe.beam_pixels
    return np.asarray(
        cv2.remap(
            image.astype(np.float32),
            columns,
            rows,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )


def _to_pixels(values: NDArray[np.float32], probe: Probe) -> NDArray[np.float32]:
    """(rows, columns) of values along the beams (samples, lines); NaN where no beam reaches."""
    lines, distances = probe.pixel_beams
    samples = distances * np.float32(probe.samples / probe.depth) - np.float32(0.5)
    beside = np.isnan(lines)
    image = cv2.remap(
        values,
        np.where(beside, np.float32(0.0), lines),
        np.where(beside, np.float32(0.0), samples),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    image[beside] = np.nan
    return np.asarray(image, dtype=np.float32)
