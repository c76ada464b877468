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
from us_sim.slicing.acoustics.path_loss import END, NOTHING, medium_at

_MOST = 40.0  # dB of loss after which more says nothing further of where it is
_DARKEST = 3e-4  # amplitude below which nothing is seen
_DARK = np.float32(100.0)  # dB, in place of more than that
_FINE = 16  # entries of the table of amplitudes a dB
_BRIGHT = 1.0 - 1e-4
_HALF = 6.02  # dB, half of the amplitude
_HALVINGS = 4  # of the distance between two beams
_FINER = 4  # steps a sample, of beams that look for an edge


def _amplitudes() -> np.ndarray:
    """(…,) float32 amplitude at each sixteenth of a dB of loss, to 100 dB."""
    return (10.0 ** (-np.arange(100 * _FINE + 2) / (20.0 * _FINE))).astype(np.float32)


AMPLITUDES = _amplitudes()


@njit(cache=True, nogil=True, error_model="numpy")
def cast_shadows(first, beams, blocked, blocker, distance, aperture, spacing, amplitudes, gain):
    """Takes what blocks from the gain, with soft edges, from sample ``first`` on.

    Args:
        beams: how many there are; the arrays may have room for more.
        blocked: (samples, beams) float32 dB, blocker: the sample where it is lost.
        distance: (samples,) m. aperture: (samples,) m. spacing: (samples,) m between beams.
        amplitudes: as `AMPLITUDES`. gain: (samples, beams) float32 dB, changed.
    """
    samples = len(blocked)
    light = np.zeros(beams + 1, dtype=np.float32)
    weight = np.zeros(beams + 1, dtype=np.float32)
    place = np.zeros(beams + 1, dtype=np.float32)
    finest = len(amplitudes) - 2
    for s in range(first, samples):
        own = blocked[s]
        left = beams
        right = 0
        for k in range(beams):
            lost = own[k]
            if lost == np.float32(0.0):
                light[k + 1] = light[k] + np.float32(1.0)
                weight[k + 1] = weight[k]
                place[k + 1] = place[k]
                continue
            left = k if left == beams else left
            right = k
            fine = lost * np.float32(_FINE)
            entry = int(fine) if fine < finest else finest
            part = min(fine - np.float32(entry), np.float32(1.0))
            a = amplitudes[np.uint64(entry)]
            a += part * (amplitudes[np.uint64(entry + 1)] - a)
            light[k + 1] = light[k] + a
            heavy = min(lost, np.float32(_MOST))
            weight[k + 1] = weight[k] + heavy
            place[k + 1] = place[k] + heavy * blocker[s, k]
        reach = int(0.5 * aperture[s] / spacing[s]) + 1
        for k in range(left - reach if left > reach else 0, min(right + reach + 1, beams)):
            low = k - reach if k > reach else 0
            high = k + reach + 1 if k + reach < beams else beams
            heavy = weight[high] - weight[low]
            if heavy <= 0.0:
                continue
            r0 = (place[high] - place[low]) / heavy
            r0 = min(max(r0, np.float32(0.0)), np.float32(s))
            near = int(r0)
            wide = aperture[s] * (1.0 - distance[near] / distance[s]) / spacing[near]
            if wide < 1.0:
                lit = light[k + 1] - light[k]
            else:
                lit = _mean(light, k + 0.5 - 0.5 * wide, k + 0.5 + 0.5 * wide, beams)
            if lit < _DARKEST:
                gain[s, k] -= _DARK
            elif lit < _BRIGHT:
                gain[s, k] += np.float32(20.0) * np.log10(np.float32(lit))


@njit(inline="always", error_model="numpy")
def _mean(total, low, high, count):
    """The mean between two places of what sums up to ``total`` (count + 1,).

    Beyond its ends the outermost values go on, so that an edge near them stays where it is.
    """
    one = min(max(int(np.floor(low)), 0), count - 1)
    other = min(max(int(np.floor(high)), 0), count - 1)
    a = total[one] + (low - one) * (total[one + 1] - total[one])
    b = total[other] + (high - other) * (total[other + 1] - total[other])
    return (b - a) / (high - low)


@njit(cache=True, nogil=True, error_model="numpy")
def sharpen_edges(
    elements, wide, steps, maps, voxels, shape, lines, media, samples, beams, blocked, blocker
):
    """Moves the edges of what blocks from halfway between two beams to where they are.

    Between a beam that is blocked and one that is not, further beams are followed, in finer steps;
    the part of a beam's width that is not blocked then lets that much through.

    Args:
        elements: (pixels,) flat, ``wide`` a row, every ``steps`` (2,) rows and columns.
        maps, voxels, shape, lines, media: as for `path_loss.follow_beams`.
        blocked, blocker: (samples, beams) float32, changed.
    """
    last = samples - 1
    for side in (1, -1):
        for k in range(beams):
            dark = k + side
            if not (0 <= dark < beams):
                continue
            if blocked[last, k] > _HALF or blocked[last, dark] <= _HALF:
                continue
            low = 0.0  # beams from the lit one towards the dark one
            high = 1.0
            if _is_blocked(k, 0.0, dark, elements, wide, steps, maps, voxels, shape, lines, media,
                           samples):  # fmt: skip
                # Its samples missed a corner.
                low, high = -1.0, 0.0
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                if _is_blocked(k, middle, dark, elements, wide, steps, maps, voxels, shape, lines,
                               media, samples):  # fmt: skip
                    high = middle
                else:
                    low = middle
            edge = 0.5 * (low + high)
            # Each beam stands for half a beam to either side of it.
            for one, lit in ((k - side, edge + 1.5), (k, edge + 0.5), (dark, edge - 0.5)):
                if 0 <= one < beams and 0.0 < lit < 1.0:
                    _let_through(samples, one, dark, lit, blocked, blocker)
                elif 0 <= one < beams and lit <= 0.0 and one != dark:
                    _let_through(samples, one, dark, 0.0, blocked, blocker)


@njit(cache=True, nogil=True, error_model="numpy")
def _let_through(samples, one, dark, lit, blocked, blocker):
    """Has a beam blocked as the dark one is, but for a part of its width."""
    for s in range(samples):
        loss = blocked[s, dark]
        if loss > np.float32(0.0):
            through = lit + (1.0 - lit) * 10.0 ** (-loss / 20.0)
            blocked[s, one] = -20.0 * np.log10(max(through, 1e-6))
            blocker[s, one] = blocker[s, dark]


@njit(cache=True, nogil=True, error_model="numpy")
def _is_blocked(k, part, dark, elements, wide, steps, maps, voxels, shape, lines, media, samples):
    """Whether the beam between two, so many parts from the first, loses half its amplitude."""
    first = lines[k] + part * (lines[dark] - lines[k])
    sides = (shape[0], shape[1], shape[2])
    ends = (sides[0] + END, sides[1] + END, sides[2] + END)
    rows = len(elements) // wide
    lost = 0.0
    was = np.uint8(NOTHING)
    for s in range(samples * _FINER):
        at = (s + 0.5) / _FINER - 0.5
        column = first[0] + at * first[2]
        row = first[1] + at * first[3]
        r = min(max(int(row / steps[0] + 0.5), 0), rows - 1)
        c = min(max(int(column / steps[1] + 0.5), 0), wide - 1)
        element = elements[r * wide + c]
        medium = np.uint8(NOTHING)
        if element >= 0:
            m = maps[element]
            medium = medium_at(
                m[0, 0] + m[0, 1] * column + m[0, 2] * row,
                m[1, 0] + m[1, 1] * column + m[1, 2] * row,
                m[2, 0] + m[2, 1] * column + m[2, 2] * row,
                voxels, sides, ends, media.of_label,
            )  # fmt: skip
        if media.blocks[medium]:
            lost += media.shadow[medium] / _FINER
        if medium != was and (media.blocks[medium] or media.blocks[was]):
            lost += media.crossing[was, medium]
        was = medium
        if lost > _HALF:
            return True
    return False
