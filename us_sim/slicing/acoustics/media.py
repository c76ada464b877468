"""The beams along which sound is followed, and the tables of the media they meet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.settings.spelling import describe_unknown
from us_sim.slicing.acoustics.path_loss import NOTHING, Media
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.acoustics.surface_echo import MIRROR
from us_sim.slicing.probe.probe import LinearProbe, Probe
from us_sim.volume.structure_names import AROUND
from us_sim.volume.volume import Volume

_SOFT = (0.8e6, 3.0e6)
"""Rayl, of soft tissue and fluid: what has more or less is bone or gas, which casts a shadow."""
_FAINTEST = -200.0  # dB, in place of nothing


def convert_attenuation(attenuation: float, frequency: float) -> float:
    """Return the dB/m that an echo loses there and back, at an attenuation in dB/cm/MHz and Hz."""
    return 2.0 * attenuation * 100.0 * frequency * 1e-6


def compute_reflection(before: float, behind: float) -> float:
    """Return the fraction of the amplitude that a border of two impedances (Rayl) reflects."""
    return (behind - before) / (behind + before)


def compute_crossing_loss(before: float, behind: float) -> float:
    """Return the dB that a border takes from an echo from behind it, there and back."""
    return float(-20.0 * np.log10(max(1.0 - compute_reflection(before, behind) ** 2, 1e-10)))


def collect_label_constants(volume: Volume, acoustics: Acoustics) -> dict[int, TissueAcoustics]:
    """Return the constants of each label that has a name, and of 0.

    Raises:
        ProbeError: a label has none, or there are constants of a label that there is not.
    """
    names = {0: AROUND, **volume.label_names}
    for name in acoustics.tissues:
        if name not in names.values():
            known = sorted(set(names.values()))
            raise acoustics.make_error(
                f"tissues.{name}", f"the volume's label {describe_unknown(name, known)}"
            )
    found = {}
    for label, name in names.items():
        try:
            found[label] = acoustics.tissues.get(name, TissueAcoustics()).fill_from_table(name)
        except ProbeError as error:
            raise acoustics.make_error(f"tissues.{error.key}", error.problem) from error
    return found


def build_media(
    volume: Volume, acoustics: Acoustics, frequency: float, step: float
) -> tuple[Media, list[TissueAcoustics], NDArray[np.float64]]:
    """Return the tables, the constants of media 1 and up, and the directions of fibres (D, 3).

    Args:
        volume: whose labels the media are of.
        acoustics: the settings.
        frequency: Hz.
        step: m, between samples.

    Raises:
        ProbeError: as `collect_label_constants`.
    """
    by_label = collect_label_constants(volume, acoustics)
    of_label = np.full(256, NOTHING, dtype=np.uint8)
    constants: list[TissueAcoustics] = []
    directions: list[tuple[float, float, float]] = []
    for label, tissue in by_label.items():
        if tissue not in constants:
            constants.append(tissue)
        of_label[label] = 1 + constants.index(tissue)
        is_used = acoustics.anisotropy and tissue.has_fibres
        if is_used and tissue.fibres is not None and tissue.fibres not in directions:
            directions.append(tissue.fibres)
    count = 1 + len(constants)
    loss, shadow, scattering, anisotropy = np.zeros((4, count), np.float32)
    crossing, half_sine = np.zeros((count, count), np.float32), np.ones(count, np.float32)
    fibres = np.full(count, -1, dtype=np.int32)
    blocks = np.zeros(count, dtype=np.bool_)
    for number, tissue in enumerate(constants, 1):
        assert tissue.attenuation is not None
        assert tissue.impedance is not None
        scattering[number] = tissue.scattering
        if acoustics.attenuation:
            per_sample = step * convert_attenuation(1.0, frequency)
            loss[number] = per_sample * tissue.attenuation
            blocks[number] = not _SOFT[0] <= tissue.impedance <= _SOFT[1]
            if blocks[number]:
                nominal = min(tissue.attenuation, acoustics.compensation)
                loss[number] = per_sample * nominal
                shadow[number] = per_sample * (tissue.attenuation - nominal)
            for other, behind in enumerate(constants, 1):
                assert behind.impedance is not None
                crossing[number, other] = compute_crossing_loss(tissue.impedance, behind.impedance)
        if tissue.fibres in directions:
            fibres[number] = directions.index(tissue.fibres)
            anisotropy[number] = tissue.anisotropy
            half_sine[number] = np.sin(tissue.half_angle) ** 2
    media = Media(
        of_label, loss, shadow, crossing, blocks, scattering, fibres, anisotropy, half_sine
    )
    unit = np.array(directions).reshape(-1, 3)
    return media, constants, unit / np.linalg.norm(unit, axis=1, keepdims=True)


def compute_surface_levels(constants: Sequence[TissueAcoustics]) -> NDArray[np.float32]:
    """Return (media, media) dB: echoes of borders at a right angle; the strongest shown is 0."""
    count = 1 + len(constants)
    levels = np.full((count, count), _FAINTEST)
    for a, before in enumerate(constants, 1):
        for b, behind in enumerate(constants, 1):
            given = [t.reflection for t in (before, behind) if t.reflection is not None]
            if a == b:
                continue
            if given:
                levels[a, b] = max(given)
                continue
            assert before.impedance is not None
            assert behind.impedance is not None
            ratio = abs(compute_reflection(before.impedance, behind.impedance))
            levels[a, b] = MIRROR + 20.0 * np.log10(max(ratio, 1e-10))
    return levels.astype(np.float32)


LOCATED = (2, 2)
"""Rows and columns from one pixel to the next of those that beams know the place of."""

_STEP = 0.45e-3  # m, between samples, where the image is as fine as that
_PIXELS_ACROSS = 2  # a beam
_ROWS = (2, 6)  # rows a sample, at least and at most

_F_NUMBER = 2.0  # depth over the length of face that looks there
_APERTURE = (1.5e-3, 1 / 3)  # m, and fraction of the face: the least and the most that is used


class BeamGrid:
    """Beams of a probe and samples along them, both evenly spaced.

    Sample ``s`` lies ``(s + 0.5) step`` along its beam; beam ``k`` is the middle of the k-th of
    as many equal parts of the face, or of the opening angle.
    """

    def __init__(self, probe: Probe) -> None:
        lateral, axial = probe.pixel_spacing
        self.is_linear = is_linear = isinstance(probe, LinearProbe)
        rows = min(max(round(_STEP / axial), _ROWS[0]), _ROWS[1])
        self.pixels = (rows, _PIXELS_ACROSS)  # rows a sample, columns a beam of a linear array
        self.step = float(rows * axial)  # m
        self.samples = max(2, math.ceil(probe.depth / self.step - 1e-6))
        self.distance = (np.arange(self.samples) + 0.5) * self.step  # (samples,) m
        if is_linear:
            self.beams = max(1, -(-probe.columns // _PIXELS_ACROSS))
            part = (np.arange(self.beams) + 0.5) * _PIXELS_ACROSS / probe.columns
        else:
            ends = (probe.beam_starts, probe.beam_starts + probe.depth * probe.beam_directions)
            widest = max(np.linalg.norm(np.diff(end, axis=0), axis=1).sum() for end in ends)
            self.beams = max(2, math.ceil(widest / (_PIXELS_ACROSS * math.sqrt(lateral * axial))))
            part = (np.arange(self.beams) + 0.5) / self.beams
        self.starts, self.directions = probe.compute_rays(
            np.minimum(part, 1.0)
        )  # m, and unit: x and z
        x = self.starts[:, 0] + self.distance[:, None] * self.directions[:, 0]
        z = self.starts[:, 1] + self.distance[:, None] * self.directions[:, 1]
        between = np.hypot(np.diff(x, axis=1), np.diff(z, axis=1))
        self.spacing = np.full(self.samples, _PIXELS_ACROSS * lateral)  # m, between beams
        if not is_linear:
            self.spacing = np.maximum(np.median(between, axis=1), 1e-6)
        left, top = probe.image_to_probe[[0, 2], 3]
        self.columns = (x - left) / lateral  # (samples, beams), fractional
        self.rows = (z - top) / axial
        self.aperture = compute_aperture(probe, self.distance)  # (samples,) m
        self.places = self._places(probe)
        self._shape = probe.rows, probe.columns
        self._maps = None if is_linear else self._pixel_places(probe)

    @property
    def lines(self) -> NDArray[np.float64]:
        """(beams, 4): column and row of each beam's first sample, and from sample to sample."""
        first = np.stack([self.columns[0], self.rows[0]])
        return np.ascontiguousarray(
            np.concatenate([first, np.stack([self.columns[1], self.rows[1]]) - first]).T
        )

    def _places(self, probe: Probe) -> NDArray[np.int32]:
        """Return (beams, samples): the flat index of the located pixel nearest to each sample.

        Of those that beams reach, since the nearest of all may lie beside a fan.
        """
        row_step, step = LOCATED
        many = -(-probe.columns // step)
        row = np.clip(np.rint(self.rows / row_step), 0, (probe.rows - 1) // row_step).astype(int)
        column = np.clip(np.rint(self.columns / step), 0, many - 1).astype(int)
        if not self.is_linear:
            row, column = _nearest(~np.isnan(probe.pixel_beams[0, ::2, ::2]))[:, row, column]
        return np.ascontiguousarray((row * many + column).T, dtype=np.int32)

    def _pixel_places(self, probe: Probe) -> tuple[NDArray, NDArray]:
        """Return sample and beam of each pixel, in the form that `cv2.remap` takes."""
        line, distance = probe.pixel_beams
        row, column = _nearest(~np.isnan(line))
        beam = (line[row, column] + 0.5) * (self.beams / probe.lines) - 0.5
        sample = distance[row, column] / self.step - 0.5
        beam = np.clip(beam, 0, self.beams - 1).astype(np.float32)
        sample = np.clip(sample, 0, self.samples - 1).astype(np.float32)
        nearest, fractions = cv2.convertMaps(beam, sample, cv2.CV_16SC2)
        return np.asarray(nearest), np.asarray(fractions)

    def interpolate_to_pixels(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Interpolate values (samples, beams) at the pixels (rows, columns)."""
        rows, columns = self._shape
        if self._maps is None:
            size = self.beams * self.pixels[1], self.samples * self.pixels[0]
            resized: Any = cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)
            return np.asarray(resized)[:rows, :columns]
        remapped = cv2.remap(values, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(remapped)


def _nearest(marked: NDArray[np.bool_]) -> NDArray[np.int32]:
    from scipy.ndimage import distance_transform_edt  # which only a fan needs

    nearest: NDArray[np.int32] = distance_transform_edt(
        ~marked, return_distances=False, return_indices=True
    )
    return nearest


def compute_aperture(probe: Probe, depth: NDArray[Any]) -> NDArray[np.float64]:
    """Return (D,) m, the length of face that keeps the f-number at depths (D,) m."""
    starts = probe.compute_rays(np.array([0.0, 1.0]))[0]
    length = float(np.linalg.norm(starts[1] - starts[0]))
    length = max(length, getattr(probe, "aperture", 0.0))  # a phased array uses all of its face
    least, most = _APERTURE
    return np.clip(depth / _F_NUMBER, least, max(most * length, least))
