"""Strain as a scanner estimates it, from two images of one probe.

Each window of the later image is looked for along its beam in the earlier one, where the normalised
cross-correlation is largest (Ophir et al., Ultrasonic Imaging 13:111, 1991), between samples by a
parabola through the three largest (Céspedes et al., Ultrasonic Imaging 17:142, 1995). Then the
earlier image is warped by the displacement, and the rest is looked for again (Alam and Ophir,
Ultrasound Med. Biol. 23:95, 1997). Strain is the slope of a weighted least-squares line through the
displacement (Kallel and Ophir, Ultrasonic Imaging 19:195, 1997).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import ProbeError
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import LinearProbe, Probe
from us_sim.slicing.settings import StrainSettings
from us_sim.slicing.strain import AxialStrain, compute_displacement
from us_sim.volume.volume import Volume


def fit_slopes(values: ArrayLike, weight: ArrayLike, length: int) -> NDArray[np.float32]:
    """Fit the slope (per sample) at each sample of (samples, lines) values, down the columns.

    Args:
        values: (samples, lines), finite also where they have no weight.
        weight: (samples, lines).
        length: samples of the line that is fitted, odd.

    Returns:
        NaN where fewer than two samples, or less than half of the line's weight, are there.
    """
    w = np.asarray(weight, dtype=np.float64)
    weighted = np.asarray(values, dtype=np.float64) * w
    place = np.arange(len(w), dtype=np.float64)[:, None] * np.ones_like(w)

    def total(terms: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(
            cv2.boxFilter(terms, -1, (1, length), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )

    s0, s1, s2 = total(w), total(w * place), total(w * place * place)
    v0, v1 = total(weighted), total(weighted * place)
    spread = s0 * s2 - s1 * s1
    enough = (spread > 1e-9) & (s0 >= 0.5 * total(np.ones_like(w)))
    found = np.where(enough, (s0 * v1 - s1 * v0) / np.where(enough, spread, 1.0), np.nan)
    return found.astype(np.float32)


_PASSES = 2  # how often the image is warped and what remains is looked for
_FLAT = 6.0**2
"""Variance of grey values (in squared levels) below which a window has nothing to be found by.

Full speckle has four times that deviation where 60 dB are shown; a shadow's noise has less.
"""

Field = NDArray[Any]  # float32
Window = tuple[Field, Field, Field]
"""An image, and the mean and standard deviation around each of its samples."""


def track_displacement(
    earlier: ArrayLike, later: ArrayLike, *, window: tuple[int, int], search: int
) -> tuple[Field, Field]:
    """Track the displacement of each sample of the later image along its beam, in samples.

    Args:
        earlier: (samples, lines) of grey values, 0 to 255.
        later: likewise.
        window: samples and lines of what is looked for, odd.
        search: samples to either side.

    Returns:
        (samples, lines): displacement, positive away from the face; and the correlation of what
        was found, -1 to 1; 0 where there is nothing to be found by, or the beams of the earlier
        image may have begun or ended within it.
    """
    first, second = (np.array(image, dtype=np.float32) for image in (earlier, later))
    size = window[::-1]
    later_window = second, *_moments(second, size)
    found, correlation = _search(first, later_window, size, search)
    moved = _smoothed(found, correlation, size)
    for _ in range(_PASSES):
        found, correlation = _refine(first, later_window, size, moved)
        moved = _smoothed(found, correlation, size)
    top, bottom = _ends(moved, correlation, window[0] // 2, search)
    correlation[:top] = correlation[bottom:] = 0.0
    return moved, correlation


def _ends(moved: Field, correlation: Field, half: int, search: int) -> tuple[int, int]:
    """Return first and end of the samples whose windows lay wholly in the earlier image.

    What has come from beyond an end is not found, or found elsewhere. How far things moved there
    is told by the nearest windows that can have come from nowhere else.
    """
    rows = len(moved)
    near = half + search
    top = bottom = 0
    for part, is_top in ((slice(near, 2 * near), True), (slice(-2 * near, -near), False)):
        there = moved[part][correlation[part] > 0.0]
        if not there.size:
            continue
        came = np.percentile(there, 95.0) if is_top else -np.percentile(there, 5.0)
        lost = half + max(0, int(np.ceil(came)))
        top, bottom = (lost, bottom) if is_top else (top, lost)
    return min(top, rows), max(rows - bottom, 0)


def _search(first: Field, later: Window, size: tuple[int, int], most: int) -> tuple[Field, Field]:
    """Return the lag in samples at which the correlation is largest, and that correlation."""
    around = cv2.copyMakeBorder(first, most + 1, most + 1, 0, 0, cv2.BORDER_REFLECT_101)
    earlier = around, *_moments(around, size)
    best = np.full_like(first, -np.inf)
    previous = np.full_like(first, -np.inf)
    before, after, found = (np.zeros_like(first) for _ in range(3))
    is_latest = np.zeros(first.shape, dtype=np.bool_)
    rows = len(first)
    for lag in range(-most - 1, most + 2):
        start = most + 1 - lag
        part = [each[start : start + rows] for each in earlier]
        level = _correlation(later, (part[0], part[1], part[2]), size)
        np.copyto(after, level, where=is_latest)
        if abs(lag) <= most:  # those beyond are only there as neighbours
            np.greater(level, best, out=is_latest)
            np.copyto(best, level, where=is_latest)
            np.copyto(before, previous, where=is_latest)
            found[is_latest] = lag
        else:
            is_latest[:] = False
        previous = level
    return found + _tip(before, best, after, 0.5), np.clip(best, -1.0, 1.0)


def _refine(
    first: Field, later: Window, size: tuple[int, int], moved: Field
) -> tuple[Field, Field]:
    """Search again in the image warped by the known displacement, up to a sample from there."""
    levels = []
    for lag in (-1.0, 0.0, 1.0):
        warped = np.empty_like(first)
        _warp(first, moved, lag, warped)
        levels.append(_correlation(later, (warped, *_moments(warped, size)), size))
    before, middle, after = levels
    return moved + _tip(before, middle, after, 1.0), np.clip(middle, -1.0, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _warp(image, moved, lag, warped):
    """Fill ``warped`` (samples, lines) with samples from ``moved + lag`` nearer the face.

    Cubic convolution (Keys, IEEE Trans. ASSP 29:1153, 1981), exact for parabolas; OpenCV's takes
    places to a 32nd of a sample only. Beyond the ends goes on what is there.
    """
    last = len(image) - 1
    for i in range(len(image)):
        for k in range(image.shape[1]):
            at = min(max(i - moved[i, k] - lag, 0.0), np.float64(last))
            m = int(at)
            if m == last:
                m -= 1
            t = at - m
            a = image[max(m - 1, 0), k]
            b = image[m, k]
            c = image[m + 1, k]
            d = image[min(m + 2, last), k]
            bend = 2.0 * a - 5.0 * b + 4.0 * c - d
            twist = 3.0 * (b - c) + d - a
            warped[i, k] = b + 0.5 * t * (c - a + t * (bend + t * twist))


def _correlation(one: Window, other: Window, size: tuple[int, int]) -> Field:
    product = cv2.boxFilter(one[0] * other[0], -1, size, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray((product - one[1] * other[1]) / (one[2] * other[2]))


def _tip(before: Field, middle: Field, after: Field, most: float) -> Field:
    """Return the peak of a parabola through three values a sample apart, from the middle one."""
    bend = np.minimum(before - 2.0 * middle + after, np.float32(-1e-6))
    return np.asarray(np.clip(0.5 * (before - after) / bend, -most, most), dtype=np.float32)


def _moments(image: Field, size: tuple[int, int]) -> tuple[Field, Field]:
    border = cv2.BORDER_REFLECT_101
    mean = cv2.boxFilter(image, -1, size, borderType=border)
    variance = cv2.sqrBoxFilter(image, -1, size, borderType=border) - mean * mean
    return mean, np.where(
        variance > _FLAT, np.sqrt(np.maximum(variance, _FLAT)), np.float32(np.inf)
    )


def _smoothed(moved: Field, correlation: Field, size: tuple[int, int]) -> Field:
    """Smooth displacements: a median against outliers, then a mean weighted by correlation.

    Windows that the image's ends cut off go on as the whole ones beside them do.
    """
    half = size[1] // 2
    moved = cv2.medianBlur(moved.astype(np.float32), 5)
    last = len(moved) - half - 1
    moved[:half] = 2.0 * moved[half] - moved[2 * half : half : -1]
    moved[last + 1 :] = 2.0 * moved[last] - moved[last - 1 : last - half - 1 : -1]
    weight = np.maximum(correlation, 1e-3) ** 4
    small = (max(3, size[0] // 2 | 1), max(3, size[1] // 4 | 1))
    total = cv2.GaussianBlur(weight, small, 0.0)
    return np.asarray(cv2.GaussianBlur(weight * moved, small, 0.0) / total, dtype=np.float32)


_STEEPEST = 0.5  # of displacement along a beam: what is found steeper than that is not tissue


class StrainEstimate(NamedTuple):
    """An estimate of strain between two images."""

    strain: NDArray[np.float32]  # (rows, columns), defined as `AxialStrain`'s; NaN where not found
    correlation: float
    """Mean correlation of what was looked for with what was found, 0 to 1; 0 where nothing was.

    Displacement along the beams is compensated, so it falls with what is not: motion across the
    beams and across the image, and strain within windows. It is the first factor of Jiang, Hall
    and Sommer's descriptor of how well strain images come out (Ultrasonic Imaging 28:1, 2006).
    """


def estimate_strain(
    earlier: NDArray[np.uint8], later: NDArray[np.uint8], probe: Probe, settings: StrainSettings
) -> StrainEstimate:
    """Track the earlier image's windows along the beams, and fit lines to their displacement.

    Both images are (rows, columns), of the probe.

    Raises:
        ProbeError: a window is longer than half a beam.

    Examples:
        >>> import numpy as np
        >>> from us_sim.slicing.probe.probe import LinearProbe
        >>> from us_sim.slicing.settings import StrainSettings
        >>> probe = LinearProbe(0.02, 0.03, columns=100, rows=300, lines=100, samples=300)
        >>> speckle = np.random.default_rng(0).integers(0, 256, (300, 100)).astype(np.uint8)
        >>> same = estimate_strain(speckle, speckle, probe, StrainSettings())
        >>> float(abs(np.nan_to_num(same.strain)).max()) < 2e-3, round(same.correlation, 3)
        (True, 1.0)
    """
    require_short_windows(probe, settings)
    step = probe.depth / probe.samples
    across = probe.width  # between lines
    if probe.lines > 1:
        middle = probe.beam_starts + 0.5 * probe.depth * probe.beam_directions
        across = float(np.linalg.norm(np.diff(middle, axis=0), axis=1).mean())
    window = _odd(settings.window / step), _odd(settings.window / 3.0 / across)
    search = max(1, round(settings.search / step))
    pixels = probe.beam_pixels
    first, second = (_remapped(each.astype(np.float32), *pixels) for each in (earlier, later))
    moved, correlation = track_displacement(first, second, window=window, search=search)
    weight = correlation >= max(settings.correlation, 1e-3)
    steep = fit_slopes(moved, weight, _odd(settings.fit / step))
    steep[np.abs(steep) > _STEEPEST] = np.nan
    # The place in the earlier image changes by 1 - steep along the beam of the later one.
    strain = steep / (np.float32(1.0) - steep)
    seen = correlation != 0.0
    mean = float(np.maximum(correlation[seen], 0.0).mean()) if seen.any() else 0.0
    return StrainEstimate(_to_pixels(strain, probe), mean)


def require_short_windows(probe: Probe, settings: StrainSettings) -> None:
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
    return max(3, 2 * round((count - 1.0) / 2.0) + 1)


def _to_pixels(values: NDArray[np.float32], probe: Probe) -> NDArray[np.float32]:
    """Convert values along the beams (samples, lines) to (rows, columns); NaN beside the beams."""
    lines, distances = probe.pixel_beams
    samples = distances * np.float32(probe.samples / probe.depth) - np.float32(0.5)
    beside = np.isnan(lines)
    image = _remapped(values, *(np.where(beside, np.float32(0.0), at) for at in (lines, samples)))
    image[beside] = np.nan
    return image


def _remapped(image: Field, columns: Field, rows: Field) -> Field:
    edge = cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=edge))


class FrameHistory:
    """The last frames of one probe and one mesh, as far as they follow one another."""

    def __init__(self, kept: Callable[[Frame], Any]) -> None:
        self._kept = kept
        self._of: tuple[Any, Any] = (None, None)
        self._frames: deque[tuple[int, Any]] = deque()

    def get_before(self, frame: Frame, interval: int) -> Any:
        """Return the value kept of the frame ``interval`` before, or None; keep this frame's, too.

        A frame may be asked about again.
        """
        probe, mesh = self._of
        if probe is not frame.probe or mesh is not frame.mesh:
            self._of = frame.probe, frame.mesh
            self._frames.clear()
        if not self._frames or self._frames[-1][0] != frame.number:
            self._frames.append((frame.number, self._kept(frame)))
        while self._frames[0][0] < frame.number - interval:
            self._frames.popleft()
        number, kept = self._frames[0]
        return kept if number == frame.number - interval else None


@cache
def warm_up() -> None:
    """Compile every kernel of displacement and strain, or load it; once in a process."""
    voxels = np.zeros((2, 2, 2), dtype=np.uint8)
    nodes = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]]) - 2e-4
    scanner = BMode(
        Volume(voxels, np.eye(4)), LinearProbe(aperture=0.01, depth=0.01, columns=4, rows=4)
    )
    scanner.attach_mesh(nodes, np.array([[0, 1, 2, 3]]))
    frame = scanner.make_frame(Pose(), 1.1 * nodes)
    compute_displacement(frame)
    track_displacement(np.zeros((40, 4)), np.zeros((40, 4)), window=(3, 3), search=1)
    AxialStrain.from_frame(frame).compute_strain(frame)
