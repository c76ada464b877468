"""Loss along each beam, borders that it crosses, and the soft shadows of bone and gas.

In a tissue of attenuation α (dB/cm/MHz, one way) an echo loses 2 α f dB each centimetre. A border
of impedances Z1 and Z2 reflects R = (Z2 - Z1) / (Z2 + Z1) of the amplitude, and of an echo from
behind it 1 - R² passes both ways together (Szabo 2014, section 3.3). Crossings are found to a 64th
of a sample.

An echo at depth r is formed by an aperture D. Past a blocker at depth r0 its shadow's edge is a
strip D (r - r0) / r wide; the amplitude is the mean over that strip of what straight beams bring
(Fernando, Percentage-closer soft shadows, 2005).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.cutting.span_sampling import SLACK

NOTHING = 0  # the medium where there is no tissue
_BEGIN = -0.5 - SLACK
END = -0.5 + SLACK  # of a volume, in voxels from its side
_BITS = 24  # of a fixed-point coordinate, behind its point
_PER_VOXEL = float(1 << _BITS)
_UNIT = 1.0 / _PER_VOXEL
_FARTHEST = 1e6  # voxels
_CLOSE = 4  # voxels from one look to the next, at most
_LEAP = _CLOSE << _BITS
_MOST_PARTS = 8  # looks from one place on a beam to the next
_LEGS = 3  # from one sample to the next, where these lie in different tetrahedra
_HALF = 0.5 + SLACK  # of a voxel, from its face to its centre, and rounding
_HALVINGS = 6  # of a sample, to find where a beam crosses a border
_DARK = 30.0  # dB after which it does not matter where more is lost


class Media(NamedTuple):
    """The media of a volume's labels at one frequency; medium 0 is `NOTHING`."""

    of_label: NDArray[np.uint8]  # (256,) the medium of each label
    loss: NDArray[np.float32]  # (media,) dB, of an echo in a sample's length, as of soft tissue
    shadow: NDArray[np.float32]  # (media,) dB likewise, that bone and gas take beyond it
    crossing: NDArray[np.float32]  # (media, media) dB, of an echo from behind the border
    blocks: NDArray[np.bool_]  # (media,) whether it is bone or gas
    scattering: NDArray[np.float32]  # (media,) dB
    fibres: NDArray[np.int32]  # (media,) which direction its fibres have, -1 without
    anisotropy: NDArray[np.float32]  # (media,) dB, most by which they fade
    half_sine: NDArray[np.float32]  # (media,) square of the sine at which half of that is lost


class Crossings(NamedTuple):
    """Places where beams enter another medium; only the first entries of each array are used."""

    beam: NDArray[np.int32]
    distance: NDArray[np.float32]  # in samples from the first one
    media: NDArray[np.uint8]  # (crossings, 2) before and behind
    element: NDArray[np.int32]  # the map that holds there
    voxel: NDArray[np.float32]  # (crossings, 3) voxel index just behind
    slope: NDArray[np.float32]  # (crossings, 3) voxels a sample
    level: NDArray[np.float32]  # dB of the soft loss and the time gain there


def allocate_crossings(count: int) -> Crossings:
    """Allocate arrays for ``count`` crossings."""
    return Crossings(
        np.empty(count, np.int32), np.empty(count, np.float32), np.empty((count, 2), np.uint8),
        np.empty(count, np.int32), np.empty((count, 3), np.float32),
        np.empty((count, 3), np.float32), np.empty(count, np.float32),
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def trace_beams(  # noqa: PLR0913
    elements, wide, steps, maps, voxels, shape, places, lines, across, along, media, time_gain,
    fibre, gain, blocked, blocker, crossings,
):  # fmt: skip
    """Fill gain, blocked and blocker; return the numbers of crossings and of clear samples.

    Shapes and units:
        elements: (pixels,) as `LocatedPixels.elements`, flat, ``wide`` a row, every ``steps`` (2,)
            rows and columns; maps: as there. voxels: (I*J*K,) uint8 labels, shape: (3,) its sides.
        places: (beams, samples) int32, of the element at each sample.
        lines: (beams, 4) column and row of the first sample, and from each to the next.
        across, along: (beams,) float32, the beams' directions as x and z.
        time_gain: (samples,) float32 dB.
        fibre: (E + 1, directions, 2) float32, x and z of the unit fibres of each map.
        gain: (samples, beams) float32 dB, all but what blocks.
        blocked, blocker: (samples, beams) float32 dB lost to what blocks, and the mean sample at
            which it is lost.
    """
    beams, samples = places.shape
    found = 0
    first_blocked = samples
    nothing = np.float32(0.0)
    of_label = media.of_label
    sides = (shape[0], shape[1], shape[2])
    for k in range(beams):
        soft_loss = block_loss = block_sample = nothing
        previous = np.uint8(NOTHING)
        x = y = z = np.int64(0)
        gx = gy = gz = np.int64(0)
        line = (lines[k, 0], lines[k, 1], lines[k, 2], lines[k, 3])
        last_element = np.int32(-2)  # the element whose gradient is gx, gy, gz
        for s in range(samples):
            element = elements[np.uint64(places[k, s])]
            medium = np.uint8(NOTHING)
            px, py, pz = x, y, z
            if element >= 0:
                if element == last_element:
                    x += gx
                    y += gy
                    z += gz
                else:
                    m = maps[np.uint64(element)]
                    x, y, z = _locate_voxel(m, line, s)
                    gx = _fixed(m[0, 1] * line[2] + m[0, 2] * line[3])
                    gy = _fixed(m[1, 1] * line[2] + m[1, 2] * line[3])
                    gz = _fixed(m[2, 1] * line[2] + m[2, 2] * line[3])
                medium = _medium_in(x, y, z, voxels, sides, of_label)
            is_far = max(max(abs(x - px), abs(y - py)), abs(z - pz)) >= _LEAP
            if medium == previous and not is_far:
                length = np.float32(0.5) if s == 0 else np.float32(1.0)
                soft_loss += length * media.loss[medium]
                if media.blocks[medium]:
                    block_loss, block_sample = _block(
                        length * media.shadow[medium], s, block_loss, block_sample
                    )
            else:
                # Another tetrahedron is squeezed otherwise, which matters where a border may be.
                is_within = previous != NOTHING and min(element, last_element) >= 0
                legs = _LEGS if is_within and element != last_element else 1
                soft_loss, block_loss, block_sample, previous, found = _follow_step(
                    k, s, legs, (px, py, pz), (x, y, z), element, previous, medium, soft_loss,
                    block_loss, block_sample, line, elements, wide, steps, maps, voxels, sides,
                    media, time_gain[s], crossings, found,
                )  # fmt: skip
            last_element = element
            level = time_gain[s] - soft_loss + media.scattering[medium]
            direction = media.fibres[medium]
            if direction >= 0:
                sine = (
                    fibre[element, direction, 0] * across[k]
                    + fibre[element, direction, 1] * along[k]
                )
                square = sine * sine
                level -= media.anisotropy[medium] * square / (square + media.half_sine[medium])
            gain[s, k] = level
            blocked[s, k] = block_loss
            if block_loss > nothing:
                blocker[s, k] = block_sample
                first_blocked = min(first_blocked, s)
    return found, first_blocked


@njit(cache=True, nogil=True, error_model="numpy")
def _follow_step(  # noqa: PLR0913
    k, s, legs, before, behind, element, previous, end_medium, soft_loss, block_loss, block_sample,
    line, elements, wide, steps, maps, voxels, sides, media, time_gain, crossings, found,
):  # fmt: skip
    """Follow beam ``k`` from sample ``s - 1`` to ``s``, where it may meet borders.

    Shapes and units:
        legs: parts of the way, each in the map of the element at its end.
        before, behind: the two samples, fixed-point voxel coordinates.

    Returns:
        soft loss, loss to blockers and its mean sample (dB), last medium, number of crossings.
    """
    of_label = media.of_label
    px, py, pz = before
    for leg in range(1, legs + 1):
        ex, ey, ez = behind
        leg_element, next_medium = element, end_medium
        if leg < legs:
            at = s - 1 + leg / legs
            leg_element = _find_element(elements, wide, steps, line, at, element)
            ex, ey, ez = _locate_voxel(maps[np.uint64(leg_element)], line, at)
            next_medium = _medium_in(ex, ey, ez, voxels, sides, of_label)
        # Where tissue is squeezed there is more of it between two samples.
        parts = np.int64(1)
        if element >= 0 and previous != NOTHING:
            apart = max(max(abs(ex - px), abs(ey - py)), abs(ez - pz)) >> _BITS
            parts = np.int64(min(int(1 + apart // _CLOSE), _MOST_PARTS))
        length = np.float32(0.5) if s == 0 else np.float32(1.0 / (legs * parts))
        begin = np.float32(s - 1 + (leg - 1) / legs)
        lx, ly, lz = px, py, pz
        for q in range(1, parts + 1):
            nx, ny, nz, current = ex, ey, ez, next_medium
            if q < parts:
                nx = px + (ex - px) * q // parts
                ny = py + (ey - py) * q // parts
                nz = pz + (ez - pz) * q // parts
                current = _medium_in(nx, ny, nz, voxels, sides, of_label)
            t = length
            if current != previous:
                high, bx, by, bz = _find_border(
                    lx, ly, lz, nx, ny, nz, s, previous, current, voxels, sides, of_label
                )
                t = np.float32(high) * length
            soft_loss += t * media.loss[previous]
            if media.blocks[previous]:
                block_loss, block_sample = _block(
                    t * media.shadow[previous], s, block_loss, block_sample
                )
            if current != previous:
                if previous != NOTHING and current != NOTHING and found < len(crossings.beam):
                    crossings.beam[found] = k
                    crossings.distance[found] = begin + (q - 1) * length + t
                    crossings.media[found, 0] = previous
                    crossings.media[found, 1] = current
                    crossings.element[found] = leg_element
                    crossings.voxel[found, 0] = bx * _UNIT - _HALF
                    crossings.voxel[found, 1] = by * _UNIT - _HALF
                    crossings.voxel[found, 2] = bz * _UNIT - _HALF
                    crossings.slope[found, 0] = (ex - px) * legs * _UNIT
                    crossings.slope[found, 1] = (ey - py) * legs * _UNIT
                    crossings.slope[found, 2] = (ez - pz) * legs * _UNIT
                    crossings.level[found] = time_gain - soft_loss - block_loss
                    found += 1
                soft_loss, block_loss, block_sample = _pass_border(
                    media.crossing[previous, current], length - t, s, media.blocks[previous],
                    media.blocks[current], media.loss[current], media.shadow[current],
                    soft_loss, block_loss, block_sample,
                )  # fmt: skip
                previous = current
            lx, ly, lz = nx, ny, nz
        px, py, pz = ex, ey, ez
    return soft_loss, block_loss, block_sample, previous, found


@njit(inline="always", error_model="numpy")
def _pass_border(  # noqa: PLR0913
    border, rest, s, was_blocker, is_blocker, loss, shadow, soft_loss, block_loss, block_sample
):
    """Add what a border takes (dB), and the way behind it, ``rest`` samples."""
    if was_blocker or is_blocker:
        block_loss, block_sample = _block(border, s, block_loss, block_sample)
    else:
        soft_loss += border
    soft_loss += rest * loss
    if is_blocker:
        block_loss, block_sample = _block(rest * shadow, s, block_loss, block_sample)
    return soft_loss, block_loss, block_sample


@njit(inline="always", error_model="numpy")
def _locate_voxel(m, line, at):
    """Map a place on a beam, in samples from its first, to fixed-point voxel coordinates."""
    c = line[0] + at * line[2]
    r = line[1] + at * line[3]
    return (
        _fixed(m[0, 0] + m[0, 1] * c + m[0, 2] * r + _HALF),
        _fixed(m[1, 0] + m[1, 1] * c + m[1, 2] * r + _HALF),
        _fixed(m[2, 0] + m[2, 1] * c + m[2, 2] * r + _HALF),
    )


@njit(inline="always", error_model="numpy")
def _find_element(elements, wide, steps, line, at, instead):
    """Return the element at a place on a beam; ``instead`` where nothing is shown there."""
    c = line[0] + at * line[2]
    r = line[1] + at * line[3]
    i = np.int64(r / steps[0] + 0.5) * wide + np.int64(c / steps[1] + 0.5)
    element = elements[min(max(i, 0), len(elements) - 1)]
    return element if element >= 0 else instead


@njit(inline="always", error_model="numpy")
def _find_border(ax, ay, az, bx, by, bz, s, previous, current, voxels, sides, of_label):  # noqa: PLR0913
    """Halve the way between two media; return the part before the border, and a place behind it."""
    if s == 0 or previous == NOTHING or current == NOTHING:
        return 0.0 if s == 0 else 0.5, bx, by, bz
    high = 1.0
    part = 1.0
    for _ in range(_HALVINGS):
        part *= 0.5
        cx, cy, cz = (ax + bx) >> 1, (ay + by) >> 1, (az + bz) >> 1
        if _medium_in(cx, cy, cz, voxels, sides, of_label) == previous:
            ax, ay, az = cx, cy, cz
        else:
            bx, by, bz = cx, cy, cz
            high -= part
    return high - 0.5 * part, bx, by, bz


@njit(inline="always", error_model="numpy")
def _block(loss, s, block_loss, block_sample):
    """Add a loss at sample ``s`` to that of blockers, and to the mean sample of that."""
    if block_loss < np.float32(_DARK) and loss > np.float32(0.0):
        block_sample = np.float32((block_sample * block_loss + loss * s) / (block_loss + loss))
    return block_loss + loss, block_sample


@njit(inline="always", error_model="numpy")
def _fixed(value):
    held = min(max(value, -_FARTHEST), _FARTHEST)
    return np.int64(held * _PER_VOXEL)


@njit(inline="always", error_model="numpy")
def _medium_in(x, y, z, voxels, sides, of_label):
    """Return the medium at fixed-point coordinates, `NOTHING` beyond the volume."""
    ix, iy, iz = x >> _BITS, y >> _BITS, z >> _BITS
    # Negative ones are very large without a sign.
    is_inside = np.uint64(ix) < np.uint64(sides[0])
    is_inside &= np.uint64(iy) < np.uint64(sides[1])
    is_inside &= np.uint64(iz) < np.uint64(sides[2])
    if not is_inside:
        return np.uint8(NOTHING)
    return of_label[voxels[np.uint64((ix * sides[1] + iy) * sides[2] + iz)]]


@njit(inline="always", error_model="numpy")
def find_medium(x, y, z, voxels, sides, ends, of_label):
    """Return the medium of the voxel nearest to an index, `NOTHING` beyond the volume.

    Shapes and units:
        sides: of the volume, three int64. ends: where its last voxels end, three float64.
    """
    # Without `and`, whose branches would take longer than the comparisons.
    is_inside = (x >= _BEGIN) & (x <= ends[0])
    is_inside &= (y >= _BEGIN) & (y <= ends[1])
    is_inside &= (z >= _BEGIN) & (z <= ends[2])
    if not is_inside:
        return np.uint8(NOTHING)
    # Half a voxel further, the whole part is the nearest; at the very faces it may be one too far.
    ix = min(np.int64(x + 0.5), sides[0] - 1)
    iy = min(np.int64(y + 0.5), sides[1] - 1)
    iz = min(np.int64(z + 0.5), sides[2] - 1)
    return of_label[voxels[np.uint64((ix * sides[1] + iy) * sides[2] + iz)]]


@njit(cache=True, nogil=True, error_model="numpy")
def sharpen_borders(found, crossings, gain, blocked, media, rise, steps, pixels):
    """Set the gain of pixels between the two samples around a border as if on its beam alone.

    Between samples a gain is interpolated, which would smear what a border takes and where another
    tissue begins.

    Shapes and units:
        gain, blocked: (samples, beams) dB. rise: dB, of the time gain in a sample's length.
        steps: (2,) rows a sample and columns a beam. pixels: (rows, columns) float32 dB, changed.
    """
    rows, columns = pixels.shape
    per_sample = steps[0]
    for f in range(found):
        k = crossings.beam[f]
        at = crossings.distance[f]
        above = int(np.floor(at))
        below = above + 1
        if above < 0 or below >= len(gain) or blocked[below, k] > 0.0:
            continue
        before = rise - media.loss[crossings.media[f, 0]]
        behind = rise - media.loss[crossings.media[f, 1]]
        for row in range(
            above * per_sample + per_sample // 2, below * per_sample + per_sample // 2
        ):
            place = np.float32((row + 0.5) / per_sample - 0.5)
            if place < at:
                level = gain[above, k] + (place - np.float32(above)) * before
            else:
                level = gain[below, k] - (np.float32(below) - place) * behind
            for column in range(k * steps[1], (k + 1) * steps[1]):
                if row < rows and column < columns:
                    pixels[row, column] = level


_MOST = 40.0  # dB of loss after which more says nothing further of where it is
_DARKEST = 3e-4  # amplitude below which nothing is seen
_BLACK = np.float32(100.0)  # dB, in place of more than that
_FINE = 16  # entries of the table of amplitudes a dB
_BRIGHT = 1.0 - 1e-4
_HALF_AMPLITUDE = 6.02  # dB, half of the amplitude
_EDGE_HALVINGS = 4  # of the distance between two beams
_FINER = 4  # steps a sample, of beams that look for an edge


AMPLITUDES = (10.0 ** (-np.arange(100 * _FINE + 2) / (20.0 * _FINE))).astype(np.float32)
"""Amplitude at each sixteenth of a dB of loss, to 100 dB."""


@njit(cache=True, nogil=True, error_model="numpy")
def cast_shadows(first, beams, blocked, blocker, distance, aperture, spacing, amplitudes, gain):  # noqa: PLR0913
    """Subtract the shadows of blockers from the gain, with soft edges, from sample ``first`` on.

    Shapes and units:
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
                gain[s, k] -= _BLACK
            elif lit < _BRIGHT:
                gain[s, k] += np.float32(20.0) * np.log10(np.float32(lit))


@njit(inline="always", error_model="numpy")
def _mean(total, low, high, count):
    """Return the mean between two places, from the cumulative sums ``total`` (count + 1,).

    Beyond its ends the outermost values go on, so that an edge near them stays where it is.
    """
    one = min(max(int(np.floor(low)), 0), count - 1)
    other = min(max(int(np.floor(high)), 0), count - 1)
    a = total[one] + (low - one) * (total[one + 1] - total[one])
    b = total[other] + (high - other) * (total[other + 1] - total[other])
    return (b - a) / (high - low)


@njit(cache=True, nogil=True, error_model="numpy")
def sharpen_edges(  # noqa: PLR0913
    elements, wide, steps, maps, voxels, shape, lines, media, samples, beams, blocked, blocker
):
    """Move the edges of blockers from halfway between two beams to their true places.

    Between a beam that is blocked and one that is not, further beams are followed, in finer steps;
    the part of a beam's width that is not blocked then lets that much through.

    Shapes and units:
        elements: (pixels,) flat, ``wide`` a row, every ``steps`` (2,) rows and columns.
        maps, voxels, shape, lines, media: as for `path_loss.trace_beams`.
        blocked, blocker: (samples, beams) float32, changed.
    """
    last = samples - 1
    for side in (1, -1):
        for k in range(beams):
            dark = k + side
            if not (0 <= dark < beams):
                continue
            if blocked[last, k] > _HALF_AMPLITUDE or blocked[last, dark] <= _HALF_AMPLITUDE:
                continue
            edge = _find_edge(
                k, dark, elements, wide, steps, maps, voxels, shape, lines, media, samples
            )
            # Each beam stands for half a beam to either side of it.
            for one, lit in ((k - side, edge + 1.5), (k, edge + 0.5), (dark, edge - 0.5)):
                if 0 <= one < beams and 0.0 < lit < 1.0:
                    _let_through(samples, one, dark, lit, blocked, blocker)
                elif 0 <= one < beams and lit <= 0.0 and one != dark:
                    _let_through(samples, one, dark, 0.0, blocked, blocker)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_edge(  # noqa: PLR0913
    k, dark, elements, wide, steps, maps, voxels, shape, lines, media, samples
):
    """Find the edge of a blocker, in beams from beam ``k``, which is lit, towards the dark one."""
    low = 0.0
    high = 1.0
    if _is_blocked(k, 0.0, dark, elements, wide, steps, maps, voxels, shape, lines, media, samples):
        # Its samples missed a corner.
        low, high = -1.0, 0.0
    for _ in range(_EDGE_HALVINGS):
        middle = 0.5 * (low + high)
        if _is_blocked(
            k, middle, dark, elements, wide, steps, maps, voxels, shape, lines, media, samples
        ):
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


@njit(cache=True, nogil=True, error_model="numpy")
def _let_through(samples, one, dark, lit, blocked, blocker):
    """Block beam ``one`` as the dark one is, but for the part ``lit`` of its width."""
    for s in range(samples):
        loss = blocked[s, dark]
        if loss > np.float32(0.0):
            through = lit + (1.0 - lit) * 10.0 ** (-loss / 20.0)
            blocked[s, one] = -20.0 * np.log10(max(through, 1e-6))
            blocker[s, one] = blocker[s, dark]


@njit(cache=True, nogil=True, error_model="numpy")
def _is_blocked(k, part, dark, elements, wide, steps, maps, voxels, shape, lines, media, samples):  # noqa: PLR0913
    """Return True if the beam at a part of the way from beam ``k`` loses half its amplitude."""
    first = lines[k] + part * (lines[dark] - lines[k])
    sides = (shape[0], shape[1], shape[2])
    ends = (sides[0] + END, sides[1] + END, sides[2] + END)
    rows = len(elements) // wide
    lost = 0.0
    previous = np.uint8(NOTHING)
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
            medium = find_medium(
                m[0, 0] + m[0, 1] * column + m[0, 2] * row,
                m[1, 0] + m[1, 1] * column + m[1, 2] * row,
                m[2, 0] + m[2, 1] * column + m[2, 2] * row,
                voxels, sides, ends, media.of_label,
            )  # fmt: skip
        if media.blocks[medium]:
            lost += media.shadow[medium] / _FINER
        if medium != previous and (media.blocks[medium] or media.blocks[previous]):
            lost += media.crossing[previous, medium]
        previous = medium
        if lost > _HALF_AMPLITUDE:
            return True
    return False
