"""Echoes of the surfaces between tissues, by the angle between surface and beam.

A smooth border of impedances Z1 and Z2 reflects R = (Z2 - Z1) / (Z2 + Z1) of the amplitude at a
right angle. Facets of a rough border have slopes with a standard deviation m, so the amplitude
falls with the angle θ between beam and normal as exp(-tan²θ / (2 m²)) (Beckmann and Spizzichino,
The Scattering of Electromagnetic Waves from Rough Surfaces, 1963, chapter 5), down to a diffuse
floor.

Normals at rest are Gaussian-weighted gradients of a label's indicator function: covectors of voxel
indices, which a tetrahedron's map carries into the patient. They are kept in blocks of 8³ voxels.
"""

from __future__ import annotations

from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.volume.volume import Volume

MIRROR = 11.0
"""dB: echo of a plane that reflects everything at a right angle, where the strongest shown is 0."""

ROUGHNESS = 0.35  # standard deviation of the slopes of a border's facets
_DIFFUSE = -25.0  # dB, of what a rough border sends in all directions, at a right angle
_GRAZING = 0.3  # least cosine for the slope with which an echo is drawn
_GRAIN_SIDE = 16  # voxels
_STEEPEST = 0.05  # least rate at which rows lead away from a border that is not along them
_LONGEST = 1.2  # pulse lengths on either side of a border that are drawn
_FLAT = 1e-30


def compute_angle_loss(cosine: Any) -> Any:
    """Return the dB by which a border is fainter, seen at an angle with that cosine (any shape)."""
    square = np.maximum(np.square(cosine), 1e-6)
    facets = np.exp(-(1.0 - square) / square / (2.0 * ROUGHNESS**2))
    floor = 10.0 ** (_DIFFUSE / 20.0) * np.sqrt(square)
    return -20.0 * np.log10(np.maximum(facets, floor))


def _grain() -> np.ndarray:
    """Return (16, 16, 16) float32 dB: borders are patchy, as the tissue at them is."""
    random = np.random.Generator(np.random.PCG64(11))
    noise = random.standard_normal((_GRAIN_SIDE,) * 3) + 1j * random.standard_normal(
        (_GRAIN_SIDE,) * 3
    )
    frequency = np.fft.fftfreq(_GRAIN_SIDE)
    square = sum(np.square(f) for f in np.meshgrid(frequency, frequency, frequency, indexing="ij"))
    smooth = np.fft.ifftn(np.fft.fftn(noise) * np.exp(-square / (2 * 0.12**2)))
    # A smooth echo of one phase, and a weaker one that speckles.
    echo = np.abs(1.0 + 0.8 * smooth / np.sqrt(np.mean(np.abs(smooth) ** 2)))
    level = 20.0 * np.log10(np.maximum(echo, 0.1))
    return np.asarray(level - level.mean(), dtype=np.float32)


ANGLES = np.asarray(
    compute_angle_loss(np.arange(257) / 256.0), np.float32
)  # at even cosines from 0 to 1
GRAIN = _grain()


@njit(cache=True, nogil=True, error_model="numpy")
def draw_surfaces(  # noqa: PLR0913
    found, crossings, surface, normals, blocks, shape, rest_index, tetrahedra, corners,
    nodes, rigid, beam_axes, step, spacing, starts, directions, across, down, to_pixel, pulse,
    greys, angles, grain, runs, image,
):  # fmt: skip
    """Draw the echoes of the first ``found`` crossings where they are brighter than the image.

    Shapes and units:
        crossings: as `path_loss.Crossings`.
        surface: (media, media) float32 dB, of a border at a right angle.
        normals, blocks: as `SurfaceNormals`. shape: (3,) of the volume.
        rest_index: (N, 3) voxels, where the nodes are at rest. nodes: (N, 3) m, where they are.
        tetrahedra: as `LocatedPixels`. corners: (M, 4) nodes of the mesh's tetrahedra.
        rigid: (3, 3) from m to voxels, of tissue as at rest.
        beam_axes: (2, 3) unit vectors along the image's columns and rows, in ``patient``.
        step: m between samples. spacing: (samples,) m between beams.
        starts, directions: (beams, 2) m. across, down: m from column to column, and row to row.
        to_pixel: (2,) column and row of the origin of ``probe``.
        pulse: m, length of an echo. greys: grey values a dB.
        runs: (rows, 2, 2) columns that show something. image: (rows, columns) uint8, changed.
    """
    rows, columns = image.shape
    gradient = np.empty(3)
    for f in range(found):
        k = np.uint64(crossings.beam[f])
        at = crossings.distance[f]
        before = np.uint64(at) if at > 0.0 else np.uint64(0)
        level = surface[crossings.media[f, 0], crossings.media[f, 1]] + crossings.level[f]
        if level * greys + 255.0 < 1.0:
            continue
        i = min(max(np.int64(crossings.voxel[f, 0] + 0.5), 0), shape[0] - 1)
        j = min(max(np.int64(crossings.voxel[f, 1] + 0.5), 0), shape[1] - 1)
        m = min(max(np.int64(crossings.voxel[f, 2] + 0.5), 0), shape[2] - 1)
        block = blocks[i // BLOCK, j // BLOCK, m // BLOCK]
        if block < 0:
            continue
        within = ((i % BLOCK) * BLOCK + j % BLOCK) * BLOCK + m % BLOCK
        normal = normals[block, within]
        if not _carry_normal(
            normal, crossings.element[f], rest_index, tetrahedra, corners, nodes, rigid, gradient
        ):
            continue
        gx, gy, gz = gradient[0], gradient[1], gradient[2]
        length = np.sqrt(gx**2 + gy**2 + gz**2)
        nx = (gx * beam_axes[0, 0] + gy * beam_axes[0, 1] + gz * beam_axes[0, 2]) / length
        nz = (gx * beam_axes[1, 0] + gy * beam_axes[1, 1] + gz * beam_axes[1, 2]) / length
        dx, dz = directions[k, 0], directions[k, 1]
        cosine = nx * dx + nz * dz
        size = abs(cosine)
        level -= angles[np.uint64(min(size * 256.0, 256.0))]
        level += grain[i % _GRAIN_SIDE, j % _GRAIN_SIDE, m % _GRAIN_SIDE]
        if level * greys + 255.0 < 1.0:
            continue
        slope = max(size, _GRAZING) * (1.0 if cosine >= 0.0 else -1.0)
        # From the step of voxels that the beam crosses to the smooth surface.
        ahead = normal[3] / -DISTANCE
        towards = 0.0
        for axis, centre in enumerate((i, j, m)):
            part = normal[axis] / 127.0
            ahead -= part * (crossings.voxel[f, axis] - centre)
            towards += part * crossings.slope[f, axis]
        if abs(towards) > _GRAZING * abs(ahead):
            at += ahead / towards
        away = (at + 0.5) * step
        x = starts[k, 0] + away * dx
        z = starts[k, 1] + away * dz
        half = 0.5 * spacing[min(before, np.uint64(len(spacing) - 1))] + 1e-9
        longest = _LONGEST * pulse
        wide = abs(dz) * half + abs(dx) * (longest + half)
        high = abs(dx) * half + abs(dz) * longest + half * min(abs(nx / slope), 3.0)
        top, bottom = _within(
            to_pixel[1] + (z - high) / down, to_pixel[1] + (z + high) / down, rows
        )
        left, right = _within(
            to_pixel[0] + (x - wide) / across, to_pixel[0] + (x + wide) / across, columns
        )
        fading = 6.0206 * 4.0 / (pulse * pulse) * greys  # 6 dB at half the pulse's length
        _draw_echo(
            top, bottom, left, right, nx, nz, slope, dx, dz, x, z, half, longest,
            level * greys + 255.5, fading, across, down, to_pixel, runs, image,
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_echo(  # noqa: PLR0913
    top, bottom, left, right, nx, nz, slope, dx, dz, x, z, half, longest, grey, fading, across,
    down, to_pixel, runs, image,
):  # fmt: skip
    """Draw a border's echo into a box of pixels, where it is brighter than the image.

    Shapes and units:
        nx, nz: the border's normal; slope: its component along the beam, dx, dz.
        x, z: m, where the beam meets the border.
        half, longest: m, half of the beam's width, and what is drawn along it on either side.
        grey, fading: grey value at the border, and its fall over the distance squared, 1/m².
    """
    rows = image.shape[0]
    # How far a pixel in row 0 is along the beam from the border's tangent, and by row.
    by_row = nz * down / slope
    for column in range(left, right):
        qx = (column - to_pixel[0]) * across - x
        start = (nx * qx - nz * (to_pixel[1] * down + z)) / slope
        lateral = qx * dz + (to_pixel[1] * down + z) * dx
        upper, lower = top, bottom
        if by_row > _STEEPEST * down:
            upper, lower = _within((-longest - start) / by_row, (longest - start) / by_row, rows)
            upper, lower = max(upper, top), min(lower, bottom)
        for row in range(upper, lower):
            t = start + row * by_row
            shown = grey - fading * t * t
            if (
                shown > image[row, column] + 0.5
                and abs(lateral - row * down * dx) <= half
                and (
                    runs[row, 0, 0] <= column < runs[row, 0, 1]
                    or runs[row, 1, 0] <= column < runs[row, 1, 1]
                )
            ):
                image[row, column] = 255 if shown > 255.0 else int(shown)


@njit(inline="always", error_model="numpy")
def _within(low, high, count):
    """Return first and end of the whole numbers between two places, of 0 to ``count - 1``."""
    first = int(np.ceil(low))
    end = int(np.floor(high)) + 1
    return first if first > 0 else 0, end if end < count else count


@njit(inline="always", error_model="numpy")
def _carry_normal(normal, element, rest_index, tetrahedra, corners, nodes, rigid, out):
    """Carry the covector of voxel indices into the patient; return False where there is none.

    The edges d of a tetrahedron now, and e of it at rest in voxels, fulfil c · d = normal · e.
    """
    a = np.float64(normal[0])
    b = np.float64(normal[1])
    c = np.float64(normal[2])
    if a == 0.0 and b == 0.0 and c == 0.0:
        return False
    if element >= len(tetrahedra):
        for axis in range(3):
            out[axis] = a * rigid[0, axis] + b * rigid[1, axis] + c * rigid[2, axis]
        return True
    e = np.uint32(tetrahedra[element])
    n0 = np.uint32(corners[e, 0])
    n1 = np.uint32(corners[e, 1])
    n2 = np.uint32(corners[e, 2])
    n3 = np.uint32(corners[e, 3])
    base = a * rest_index[n0, 0] + b * rest_index[n0, 1] + c * rest_index[n0, 2]
    p = a * rest_index[n1, 0] + b * rest_index[n1, 1] + c * rest_index[n1, 2] - base
    q = a * rest_index[n2, 0] + b * rest_index[n2, 1] + c * rest_index[n2, 2] - base
    r = a * rest_index[n3, 0] + b * rest_index[n3, 1] + c * rest_index[n3, 2] - base
    ux = nodes[n1, 0] - nodes[n0, 0]
    uy = nodes[n1, 1] - nodes[n0, 1]
    uz = nodes[n1, 2] - nodes[n0, 2]
    vx = nodes[n2, 0] - nodes[n0, 0]
    vy = nodes[n2, 1] - nodes[n0, 1]
    vz = nodes[n2, 2] - nodes[n0, 2]
    wx = nodes[n3, 0] - nodes[n0, 0]
    wy = nodes[n3, 1] - nodes[n0, 1]
    wz = nodes[n3, 2] - nodes[n0, 2]
    determinant = ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)
    if abs(determinant) < _FLAT:
        return False
    p, q, r = p / determinant, q / determinant, r / determinant
    out[0] = p * (vy * wz - vz * wy) + q * (wy * uz - wz * uy) + r * (uy * vz - uz * vy)
    out[1] = p * (vz * wx - vx * wz) + q * (wz * ux - wx * uz) + r * (uz * vx - ux * vz)
    out[2] = p * (vx * wy - vy * wx) + q * (wx * uy - wy * ux) + r * (ux * vy - uy * vx)
    return True


BLOCK = 8
DISTANCE = 40.0  # parts of a voxel in which the distance of a surface is kept
_REACH = 3  # voxels
_SIGMA = 1.5  # voxels
_PARTS = 256  # of the weighted mean that are told apart
_WEIGHTS = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / _SIGMA) ** 2)
_WEIGHTS /= _WEIGHTS.sum()


class SurfaceNormals:
    """Normals of the borders between a volume's labels (i, j, k)."""

    def __init__(self, labels: NDArray[np.uint8]) -> None:
        self._labels = labels  # whose memory is no other volume's as long as these are kept
        shape = np.array(labels.shape, dtype=np.int64)
        self.blocks = np.full(tuple(-(-shape // BLOCK)), -1, dtype=np.int32)
        weights = _WEIGHTS.astype(np.float32)
        flat = labels.reshape(-1)
        count = _mark_blocks(flat, shape, self.blocks)
        self.normals = np.zeros((count, BLOCK**3, 4), dtype=np.int8)
        _fill_normals(flat, shape, weights, _DISTANCES, self.blocks, self.normals)


def _distances() -> NDArray[np.int8]:
    """Return (`_PARTS`,) distances of a plane, `DISTANCE`-ths of a voxel, by the part this side."""
    part = (np.arange(_PARTS) + 0.5) / _PARTS
    # A Gaussian that ends at the reach, of voxels: as the mean of a half space's would be.
    total = np.concatenate([[0.0], np.cumsum(_WEIGHTS)])
    place = np.arange(-_REACH, _REACH + 2) - 0.5
    distance = np.rint(DISTANCE * np.interp(part, total, place))
    return np.clip(distance, -127, 127).astype(np.int8)


_DISTANCES = _distances()
_found: WeakValueDictionary[tuple[int, tuple[int, ...]], SurfaceNormals] = WeakValueDictionary()


def find_surface_normals(volume: Volume) -> SurfaceNormals:
    """Return the normals of a volume's labels, found on first use (about a second).

    They are kept while somebody uses them, also for a volume of the same labels in another place.
    """
    assert volume.labels is not None
    key = volume.labels.ctypes.data, volume.labels.shape
    found = _found.get(key)
    if found is None:
        found = _found[key] = SurfaceNormals(volume.labels)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _beside_another(labels, shape, i, j, k):
    to_i = shape[1] * shape[2]
    to_j = shape[2]
    at = i * to_i + j * to_j + k
    own = labels[at]
    return (
        (i > 0 and labels[at - to_i] != own)
        or (i < shape[0] - 1 and labels[at + to_i] != own)
        or (j > 0 and labels[at - to_j] != own)
        or (j < shape[1] - 1 and labels[at + to_j] != own)
        or (k > 0 and labels[at - 1] != own)
        or (k < shape[2] - 1 and labels[at + 1] != own)
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _touches_another(labels, shape, i, j, k):
    """Return True if a voxel shares a face, edge or corner with one of another label.

    A beam may pass from voxel to voxel through any of these.
    """
    own = labels[(i * shape[1] + j) * shape[2] + k]
    for p in range(max(i - 1, 0), min(i + 2, shape[0])):
        for q in range(max(j - 1, 0), min(j + 2, shape[1])):
            row = (p * shape[1] + q) * shape[2]
            for r in range(max(k - 1, 0), min(k + 2, shape[2])):
                if labels[row + r] != own:
                    return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_blocks(labels, shape, blocks):
    """Give numbers to the blocks that have a surface; return how many there are."""
    count = 0
    for a in range(blocks.shape[0]):
        for b in range(blocks.shape[1]):
            for c in range(blocks.shape[2]):
                if _has_surface(labels, shape, a * BLOCK, b * BLOCK, c * BLOCK):
                    blocks[a, b, c] = count
                    count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _has_surface(labels, shape, i0, j0, k0):
    for i in range(i0, min(i0 + BLOCK, shape[0])):
        for j in range(j0, min(j0 + BLOCK, shape[1])):
            for k in range(k0, min(k0 + BLOCK, shape[2])):
                if _beside_another(labels, shape, i, j, k):
                    return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_normals(labels, shape, weights, distances, blocks, normals):
    for a in range(blocks.shape[0]):
        for b in range(blocks.shape[1]):
            for c in range(blocks.shape[2]):
                block = blocks[a, b, c]
                if block < 0:
                    continue
                i0, j0, k0 = a * BLOCK, b * BLOCK, c * BLOCK
                for i in range(i0, min(i0 + BLOCK, shape[0])):
                    for j in range(j0, min(j0 + BLOCK, shape[1])):
                        for k in range(k0, min(k0 + BLOCK, shape[2])):
                            if _touches_another(labels, shape, i, j, k):
                                within = ((i - i0) * BLOCK + j - j0) * BLOCK + k - k0
                                _gradient(
                                    labels, shape, weights, distances, i, j, k,
                                    normals[block, within],
                                )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _gradient(labels, shape, weights, distances, i, j, k, out):
    own = labels[(i * shape[1] + j) * shape[2] + k]
    x = y = z = total = np.float32(0.0)
    for a in range(-_REACH, _REACH + 1):
        p = min(max(i + a, 0), shape[0] - 1)
        for b in range(-_REACH, _REACH + 1):
            q = min(max(j + b, 0), shape[1] - 1)
            row = (p * shape[1] + q) * shape[2]
            both = weights[a + _REACH] * weights[b + _REACH]
            for c in range(-_REACH, _REACH + 1):
                r = min(max(k + c, 0), shape[2] - 1)
                if labels[row + r] == own:
                    w = both * weights[c + _REACH]
                    total += w
                    x += w * np.float32(a)
                    y += w * np.float32(b)
                    z += w * np.float32(c)
    length = np.sqrt(x * x + y * y + z * z)
    if length > 0.0:
        scale = np.float32(127.0) / length
        out[0] = np.int8(np.rint(scale * x))
        out[1] = np.int8(np.rint(scale * y))
        out[2] = np.int8(np.rint(scale * z))
        out[3] = distances[min(int(total * np.float32(_PARTS)), _PARTS - 1)]
