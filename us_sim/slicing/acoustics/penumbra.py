"""Soft edges of the shadows of bone and gas: how much of the aperture sees past what blocks.

An echo at depth r is formed by an aperture of length D. Of what blocks the sound at depth r0, the
beam from the aperture to the echo is D (1 - r0 / r) wide there. So behind an edge the amplitude
falls over a strip D (r - r0) / r wide, and in its middle, at the geometric edge, half of it is
left. The amplitude is the mean, over that strip, of what the straight beams in it bring (soft
shadows of area lights are made likewise: Fernando, Percentage-closer soft shadows, 2005).
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit

__all__ = ["cast_shadows"]

_MOST = 40.0  # dB of loss after which more says nothing further of where it is
_DARKEST = 3e-4  # amplitude below which nothing is seen
_DARK = np.float32(100.0)  # dB, in place of more than that
_FINE = 16  # entries of the table of amplitudes a dB
_BRIGHT = 1.0 - 1e-4


def _amplitudes() -> np.ndarray:
    """(…,) float32 amplitude at each sixteenth of a dB of loss, to 100 dB."""
    return (10.0 ** (-np.arange(100 * _FINE + 2) / (20.0 * _FINE))).astype(np.float32)


AMPLITUDES = _amplitudes()


@njit(cache=True, nogil=True, error_model="numpy")
def cast_shadows(first, blocked, blocker, distance, aperture, spacing, amplitudes, gain):
    """Takes what blocks from the gain, with soft edges, from sample ``first`` on.

    Args:
        blocked: (samples, beams) float32 dB, blocker: the sample where it is lost.
        distance: (samples,) m. aperture: (samples,) m. spacing: (samples,) m between beams.
        amplitudes: as `AMPLITUDES`. gain: (samples, beams) float32 dB, changed.
    """
    samples, beams = blocked.shape
    light = np.zeros(beams + 1, dtype=np.float32)
    weight = np.zeros(beams + 1, dtype=np.float32)
    place = np.zeros(beams + 1, dtype=np.float32)
    finest = len(amplitudes) - 2
    for s in range(first, samples):
        own = blocked[s]
        for k in range(beams):
            lost = own[k]
            fine = lost * np.float32(_FINE)
            entry = int(fine) if fine < finest else finest
            part = min(fine - np.float32(entry), np.float32(1.0))
            a = amplitudes[np.uint64(entry)]
            a += part * (amplitudes[np.uint64(entry + 1)] - a)
            light[k + 1] = light[k] + a
            heavy = min(lost, np.float32(_MOST))
            weight[k + 1] = weight[k] + heavy
            at = heavy * blocker[s, k] if lost > 0.0 else np.float32(0.0)
            place[k + 1] = place[k] + at
        if weight[beams] == 0.0:
            continue
        reach = int(0.5 * aperture[s] / spacing[s]) + 1
        for k in range(beams):
            low = k - reach if k > reach else 0
            high = k + reach + 1 if k + reach < beams else beams
            heavy = weight[high] - weight[low]
            if heavy <= 0.0:
                continue
            r0 = (place[high] - place[low]) / heavy
            r0 = min(max(r0, np.float32(0.0)), np.float32(s))
            near = int(r0)
            wide = aperture[s] * (1.0 - distance[near] / distance[s]) / spacing[near]
            lit = _mean(light, k + 0.5 - 0.5 * wide, k + 0.5 + 0.5 * wide, beams)
            if wide < 1.0:
                lit = light[k + 1] - light[k]
            if lit < _DARKEST:
                gain[s, k] -= _DARK
            elif lit < _BRIGHT:
                gain[s, k] += np.float32(20.0) * np.log10(np.float32(lit))


@njit(inline="always", error_model="numpy")
def _mean(total, low, high, count):
    """The mean between two places of what sums up to ``total`` (count + 1,)."""
    low = low if low > 0.0 else 0.0
    high = high if high < count else float(count)
    one = int(low) if low < count else count - 1
    other = int(high) if high < count else count - 1
    a = total[one] + (low - one) * (total[one + 1] - total[one])
    b = total[other] + (high - other) * (total[other + 1] - total[other])
    return (b - a) / (high - low)
