"""The same loss by casting rays in double precision, from every part of the aperture to each pixel.

Slow, and independent of how `us_sim.slicing.acoustics` goes about it: for each pixel a ray from the
face along its beam adds up what soft tissue takes, and rays from the whole aperture what bone and
gas let through, in steps of a tenth of a millimetre through the volume at rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.slicing.acoustics.media import aperture, constants_by_label, crossing_loss
from us_sim.slicing.acoustics.settings import Acoustics
from us_sim.slicing.probe.probe import Probe
from us_sim.volume.volume import Volume

_STEP = 0.1e-3  # m
_RAYS = 33  # from the aperture to a pixel
_SOFT = (0.8e6, 3.0e6)  # Rayl


def traced_gain(
    volume: Volume, probe: Probe, pose: Pose, acoustics: Acoustics
) -> NDArray[np.float64]:
    """(rows, columns) dB by which each pixel's echo is changed; NaN where no beam reaches."""
    assert volume.labels is not None
    per_metre = 200.0 * acoustics.frequency_among(probe.frequencies) * 1e-6
    by_label = constants_by_label(volume, acoustics)
    impedance, taken = np.full(256, np.nan), np.zeros(256)
    fibres, falls = np.zeros((256, 3)), np.zeros((256, 2))
    for label, tissue in by_label.items():
        assert tissue.impedance is not None
        assert tissue.attenuation is not None
        impedance[label], taken[label] = tissue.impedance, per_metre * tissue.attenuation
        if tissue.has_fibres:
            fibres[label] = np.array(tissue.fibres) / np.linalg.norm(np.array(tissue.fibres))
            falls[label] = tissue.anisotropy, np.sin(tissue.half_angle) ** 2
    blocks = (impedance < _SOFT[0]) | (impedance > _SOFT[1])
    nominal = np.where(blocks, np.minimum(taken, per_metre * acoustics.compensation), taken)
    borders = np.zeros((256, 256))
    for a in by_label:
        for b in by_label:
            borders[a, b] = crossing_loss(impedance[a], impedance[b])
    line, distance = probe.pixel_beams.astype(np.float64)
    starts, directions = probe.rays(((line + 0.5) / probe.lines).reshape(-1))
    across, down = pose.rotation[:, 0], pose.rotation[:, 2]
    start = pose.position + starts[:, :1] * across + starts[:, 1:] * down
    along = directions[:, :1] * across + directions[:, 1:] * down
    sideways = directions[:, 1:] * across - directions[:, :1] * down
    away = distance.reshape(-1)
    wide = aperture(probe, np.nan_to_num(away, nan=1.0))
    gain = np.empty(len(away))
    to_index = volume.patient_to_index[:3, :3].T
    turned = (
        start @ to_index + volume.patient_to_index[:3, 3],
        along @ to_index,
        sideways @ to_index,
    )
    _trace(
        *turned, along, away, wide, volume.labels, nominal, taken - nominal,
        borders, blocks, fibres, falls, per_metre * acoustics.compensation, gain,
    )  # fmt: skip
    return gain.reshape(line.shape)


@njit(cache=True, nogil=True, error_model="numpy")
def _trace(
    start, ahead, sideways, along, away, wide, labels, soft, hard, borders, blocks, fibres,
    falls, rise, gain,
):  # fmt: skip
    """Fills gain (pixels,) dB; start, ahead and sideways (pixels, 3) are in voxels."""
    end = np.empty(3)
    element = np.empty(3)
    for p in range(len(away)):
        if not away[p] >= 0.0:
            gain[p] = np.nan
            continue
        for a in range(3):
            end[a] = start[p, a] + away[p] * ahead[p, a]
            element[a] = start[p, a]
        lost = _ray(element, end, away[p], labels, soft, borders, blocks, False)
        light = 0.0
        for r in range(_RAYS):
            offset = ((r + 0.5) / _RAYS - 0.5) * wide[p]
            for a in range(3):
                element[a] = start[p, a] + offset * sideways[p, a]
            length = np.hypot(away[p], offset)
            blocked = _ray(element, end, length, labels, hard, borders, blocks, True)
            light += 10.0 ** (-blocked / 20.0) / _RAYS
        own = _label(end[0], end[1], end[2], labels)
        sine = 0.0
        for a in range(3):
            sine += fibres[own, a] * along[p, a]
        fall = falls[own, 0] * sine * sine / (sine * sine + falls[own, 1] + 1e-12)
        gain[p] = rise * away[p] - lost - fall + 20.0 * np.log10(max(light, 1e-6))


@njit(cache=True, nogil=True, error_model="numpy")
def _ray(start, end, length, labels, taken, borders, blocks, of_blockers):
    """dB lost on the way by what is taken along it and at borders, of blockers or of all else.

    Args:
        start, end: (3,) voxels. length: m. taken: (256,) dB/m. borders: (256, 256) dB.
    """
    count = max(1, int(np.ceil(length / _STEP)))
    x = (end[0] - start[0]) / count
    y = (end[1] - start[1]) / count
    z = (end[2] - start[2]) / count
    lost = 0.0
    was = -1
    for s in range(count):
        t = s + 0.5
        own = _label(start[0] + t * x, start[1] + t * y, start[2] + t * z, labels)
        lost += taken[own] * length / count
        if was >= 0 and own != was and (blocks[own] or blocks[was]) == of_blockers:
            lost += borders[was, own]
        was = own
    return lost


@njit(inline="always", error_model="numpy")
def _label(x, y, z, labels):
    i = int(np.floor(x + 0.5))
    j = int(np.floor(y + 0.5))
    k = int(np.floor(z + 0.5))
    if 0 <= i < labels.shape[0] and 0 <= j < labels.shape[1] and 0 <= k < labels.shape[2]:
        return np.int64(labels[i, j, k])
    return np.int64(255)  # nothing, which takes nothing
