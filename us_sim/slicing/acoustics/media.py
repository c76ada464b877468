"""From labels and their constants to the tables with which beams are followed.

>>> from us_sim.slicing.acoustics.media import crossing_loss, reflection
>>> round(float(crossing_loss(1.645e6, 6.364e6)), 2)  # dB, an echo from behind bone's surface
3.7
>>> round(float(reflection(1.327e6, 1.645e6)), 3)  # fat and muscle
0.107
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.settings.spelling import unknown
from us_sim.slicing.acoustics.path_loss import NOTHING, Media
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.acoustics.surface_echo import MIRROR
from us_sim.slicing.acoustics.tissue_table import AROUND
from us_sim.volume.volume import Volume

_SOFT = (0.8e6, 3.0e6)
"""Rayl, of soft tissue and fluid: what has more or less is bone or gas, which casts a shadow."""
_FAINTEST = -200.0  # dB, in place of nothing


def decibels_per_metre(attenuation: float, frequency: float) -> float:
    """dB/m that an echo loses there and back, at an attenuation in dB/cm/MHz and Hz."""
    return 2.0 * attenuation * 100.0 * frequency * 1e-6


def reflection(before: float, behind: float) -> float:
    """The fraction of the amplitude that a border of two impedances (Rayl) reflects."""
    return (behind - before) / (behind + before)


def crossing_loss(before: float, behind: float) -> float:
    """dB that a border takes from an echo from behind it, there and back."""
    return float(-20.0 * np.log10(max(1.0 - reflection(before, behind) ** 2, 1e-10)))


def constants_by_label(volume: Volume, acoustics: Acoustics) -> dict[int, TissueAcoustics]:
    """The constants of each label that has a name, and of 0.

    Raises:
        ProbeError: a label has none, or there are constants of a label that there is not.
    """
    names = {0: AROUND, **volume.label_names}
    for name in acoustics.tissues:
        if name not in names.values():
            known = sorted(set(names.values()))
            raise acoustics.refused(f"tissues.{name}", f"the volume's label {unknown(name, known)}")
    found = {}
    for label, name in names.items():
        try:
            found[label] = acoustics.of(name)
        except ProbeError as error:
            raise acoustics.refused(f"tissues.{error.key}", error.problem) from error
    return found


def media_of(
    volume: Volume, acoustics: Acoustics, frequency: float, step: float
) -> tuple[Media, list[TissueAcoustics], NDArray[np.float64]]:
    """The tables, the constants of media 1 and up, and the directions of fibres (D, 3).

    Args:
        frequency: Hz. step: m, between samples.

    Raises:
        ProbeError: as `constants_by_label`.
    """
    by_label = constants_by_label(volume, acoustics)
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
    loss, shadow, scattering = np.zeros(count), np.zeros(count), np.zeros(count)
    crossing = np.zeros((count, count))
    fibres = np.full(count, -1, dtype=np.int32)
    anisotropy, half_sine = np.zeros(count), np.ones(count)
    blocks = np.zeros(count, dtype=np.bool_)
    for number, tissue in enumerate(constants, 1):
        assert tissue.attenuation is not None
        assert tissue.impedance is not None
        scattering[number] = tissue.scattering
        if acoustics.attenuation:
            per_sample = step * decibels_per_metre(1.0, frequency)
            loss[number] = per_sample * tissue.attenuation
            blocks[number] = not _SOFT[0] <= tissue.impedance <= _SOFT[1]
            if blocks[number]:
                nominal = min(tissue.attenuation, acoustics.compensation)
                loss[number] = per_sample * nominal
                shadow[number] = per_sample * (tissue.attenuation - nominal)
            for other, behind in enumerate(constants, 1):
                assert behind.impedance is not None
                crossing[number, other] = crossing_loss(tissue.impedance, behind.impedance)
        if tissue.fibres in directions:
            fibres[number] = directions.index(tissue.fibres)
            anisotropy[number] = tissue.anisotropy
            half_sine[number] = np.sin(tissue.half_angle) ** 2
    media = Media(
        of_label,
        loss.astype(np.float32),
        shadow.astype(np.float32),
        crossing.astype(np.float32),
        blocks,
        scattering.astype(np.float32),
        fibres,
        anisotropy.astype(np.float32),
        half_sine.astype(np.float32),
    )
    unit = np.array(directions).reshape(-1, 3)
    return media, constants, unit / np.linalg.norm(unit, axis=1, keepdims=True)


def surface_levels(constants: Sequence[TissueAcoustics]) -> NDArray[np.float32]:
    """(media, media) dB: the echo of a border at a right angle, where the strongest shown is 0."""
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
            ratio = abs(reflection(before.impedance, behind.impedance))
            levels[a, b] = MIRROR + 20.0 * np.log10(max(ratio, 1e-10))
    return levels.astype(np.float32)
