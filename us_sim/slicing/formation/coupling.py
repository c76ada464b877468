"""Contact of the transducer's face with the skin: coupling, the layer of gel, echoes in air.

The triangles of a coarse mesh stand off a face that their nodes touch by a millimetre or two. Skin
and gel fill that layer, where no tetrahedron carries the volume; it shows the tissue beyond it,
mirrored.

Air reflects everything, so the pulse runs to and fro in the lens of the transducer: bright bands
a lens apart, each weaker than the one before, and a haze below them. Deeper echoes are formed by
more elements, so the edge of the shadow of air gets softer with depth. A partly coupled line is
weaker by the coupling in decibels. Of two echoes at one place the stronger is shown.

>>> import numpy as np
>>> from us_sim.slicing.formation.coupling import Reverberation
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.settings import Imaging
>>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=8, rows=8, lines=8)
>>> tissue = np.full((8, 8), 150, dtype=np.uint8)
>>> air = Reverberation(probe, Imaging(contact=True))
>>> air.apply_coupling(tissue, np.full(8, 0.5, np.float32))[7]  # 6 dB less
array([124, 124, 124, 124, 124, 124, 124, 124], dtype=uint8)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.geometry.collider_distance import rotate_vector_back
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import ECHO_RANGE, Imaging

GEL_FILM = (0.15e-3, 0.3e-3)
"""m: gel fills gaps between face and skin up to the first; from the second on there is air."""

GEL_BEAD = 0.2
"""Gap that gel fills in addition to `GEL_FILM`, over the depth of the face below the skin at rest.

Gel that is squeezed out gathers in the wedge where skin leaves a pressed face. The triangles of a
coarse mesh stand off a face that their nodes touch by as much.
"""

LIGHT_CONTACT = 0.2
"""Coupling where the face just touches: 14 dB less than in full contact, there and back."""

FULL_PRESS = 1e-3
"""m: depth of the face below the skin at rest at which hairs and creases are closed."""


class ContactSurface:
    """The outer surface of the body that the face can touch.

    Args:
        rest_nodes: (N, 3) m, frame ``patient``.
        triangles: (T, 3) indices into them; closed surfaces, all normals outward or all inward.
        is_outward: of an open surface, such as the skin over a part of the body: all normals are
            outward.

    Raises:
        MeshError: the arrays do not have those shapes, or a triangle names a node that is not
            there.
    """

    def __init__(
        self, rest_nodes: ArrayLike, triangles: ArrayLike, *, is_outward: bool = False
    ) -> None:
        nodes = np.array(rest_nodes, dtype=np.float64)
        corners = np.array(triangles, dtype=np.int32)
        if nodes.ndim != 2 or nodes.shape[1] != 3 or corners.ndim != 2 or corners.shape[1] != 3:
            raise MeshError(
                f"a contact surface needs nodes (N, 3) and triangles (T, 3), not {nodes.shape} "
                f"and {corners.shape}"
            )
        if corners.size and not 0 <= corners.min() <= corners.max() < len(nodes):
            raise MeshError(
                f"a contact surface of {len(nodes)} nodes has triangles that name others, from "
                f"{corners.min()} to {corners.max()}"
            )
        a, b, c = (nodes[corners[:, i]] for i in range(3))
        # Six times the volume.
        if not is_outward and np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0:
            corners = corners[:, ::-1].copy()
        self.rest_nodes = nodes
        self._triangles = corners

    def measure_contact(
        self, nodes: ArrayLike, probe: Probe, pose: Pose
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """Measure the coupling of each line, and its gap to the surface.

        Args:
            nodes: (N, 3) m, where the surface's nodes are now.
            probe: its geometry.
            pose: of the probe.

        Returns:
            (lines,) the fraction of an echo's amplitude transmitted: 0 in air, 1 in full contact;
            and (lines,) m, the gap as `measure_gaps` says.

        Raises:
            MeshError: another number of nodes than at rest.
        """
        gap, press = self.measure_gaps(nodes, probe, pose)
        near, far = GEL_FILM
        bead = GEL_BEAD * np.maximum(press, 0.0)
        wet = 1.0 - _smooth((gap - bead - near) / (far - near))
        firm = LIGHT_CONTACT + (1.0 - LIGHT_CONTACT) * _smooth(press / FULL_PRESS)
        return np.asarray(wet * firm, dtype=np.float32), gap

    def measure_gaps(
        self, nodes: ArrayLike, probe: Probe, pose: Pose
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Measure the gap between face and surface along each line, and the press there.

        Args:
            nodes: (N, 3) m, where the surface's nodes are now.
            probe: its geometry.
            pose: of the probe.

        Returns:
            (lines,) m, not positive where the face lies in the surface or within it, infinite
            where a line meets no surface; and (lines,) m, how far beyond the surface at rest the
            face is, along the line.

        Raises:
            MeshError: another number of nodes than at rest.
        """
        now = np.ascontiguousarray(nodes, dtype=np.float64)
        if now.shape != self.rest_nodes.shape:
            raise MeshError(
                f"the contact surface has {len(self.rest_nodes)} nodes at rest, but "
                f"{now.shape} coordinates came"
            )
        gap, press = np.empty(probe.lines), np.empty(probe.lines)
        _find_entries(
            now, self.rest_nodes, self._triangles, np.ascontiguousarray(pose.rotation),
            np.array(pose.position), probe.beam_starts, probe.beam_directions, gap, press,
        )  # fmt: skip
        return gap, press


def _smooth(ramp: NDArray[np.float64]) -> NDArray[np.float64]:
    """Clip a ramp to 0 and 1 without a kink at either (the smoothstep polynomial)."""
    ramp = np.clip(ramp, 0.0, 1.0)
    return ramp * ramp * (3.0 - 2.0 * ramp)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_entries(nodes, rest, triangles, rotation, position, starts, directions, gap, press):  # noqa: PLR0913
    """Find where each beam enters: last before a face that is inside, else first after it.

    Folds of a surface that was pushed hard overlap. So the face is inside if the beam entered the
    surface more often than it left it, whatever it did last.

    Shapes and units:
        nodes, rest: (N, 3); triangles (T, 3), normals outward.
        rotation: (3, 3) from frame ``probe``; position (3,).
        starts, directions: (lines, 2).
        gap, press: (lines,), set.
    """
    lines = len(starts)
    entered = np.full(lines, -np.inf)
    depth = np.zeros(lines, dtype=np.int64)  # of the face: times entered less times left before it
    moved = np.zeros(lines)
    gap[:] = np.inf
    press[:] = 0.0
    point = np.empty((3, 5))  # of a triangle's corners: x, y, z of now in frame probe, and moved
    ends = np.empty((2, 4))  # of a cut: x, z, and the displacement along them
    for t in range(len(triangles)):
        above = 0
        for c in range(3):
            n = triangles[t, c]
            dx = nodes[n, 0] - position[0]
            dy = nodes[n, 1] - position[1]
            dz = nodes[n, 2] - position[2]
            point[c, 0], point[c, 1], point[c, 2] = rotate_vector_back(rotation, dx, dy, dz)
            above += point[c, 1] >= 0.0
        if above == 0 or above == 3:
            continue
        for c in range(3):
            n = triangles[t, c]
            dx = nodes[n, 0] - rest[n, 0]
            dy = nodes[n, 1] - rest[n, 1]
            dz = nodes[n, 2] - rest[n, 2]
            point[c, 3], _, point[c, 4] = rotate_vector_back(rotation, dx, dy, dz)
        found = 0
        for c in range(3):
            d = (c + 1) % 3
            ya, yb = point[c, 1], point[d, 1]
            if (ya >= 0.0) != (yb >= 0.0):
                fraction = ya / (ya - yb)
                for q, axis in enumerate((0, 2, 3, 4)):
                    ends[found, q] = point[c, axis] + fraction * (point[d, axis] - point[c, axis])
                found += 1
        # The normal's x and z, of any length.
        ux = point[1, 0] - point[0, 0]
        uy = point[1, 1] - point[0, 1]
        uz = point[1, 2] - point[0, 2]
        vx = point[2, 0] - point[0, 0]
        vy = point[2, 1] - point[0, 1]
        vz = point[2, 2] - point[0, 2]
        normal_x = uy * vz - uz * vy
        normal_z = ux * vy - uy * vx
        _meet_lines(ends, normal_x, normal_z, starts, directions, depth, entered, moved, gap, press)
    for line in range(lines):
        if depth[line] > 0:
            gap[line] = entered[line]
            press[line] = moved[line] - entered[line]


@njit(cache=True, nogil=True, error_model="numpy")
def _meet_lines(  # noqa: PLR0913
    ends, normal_x, normal_z, starts, directions, depth, entered, moved, gap, press
):
    """Count where lines enter or leave by a triangle's cut, and keep the nearest entries."""
    for line in range(len(starts)):
        x0, z0 = starts[line, 0], starts[line, 1]
        x, z = directions[line, 0], directions[line, 1]
        a = (ends[0, 0] - x0) * z - (ends[0, 1] - z0) * x
        b = (ends[1, 0] - x0) * z - (ends[1, 1] - z0) * x
        if (a >= 0.0) == (b >= 0.0):
            continue
        fraction = a / (a - b)
        distance = (ends[0, 0] + fraction * (ends[1, 0] - ends[0, 0]) - x0) * x + (
            ends[0, 1] + fraction * (ends[1, 1] - ends[0, 1]) - z0
        ) * z
        along = (ends[0, 2] + fraction * (ends[1, 2] - ends[0, 2])) * x + (
            ends[0, 3] + fraction * (ends[1, 3] - ends[0, 3])
        ) * z
        inward = normal_x * x + normal_z * z < 0.0
        if distance <= 0.0:
            depth[line] += 1 if inward else -1
            if inward and distance > entered[line]:
                entered[line] = distance
                moved[line] = along
        elif inward and distance < gap[line]:
            gap[line] = distance
            press[line] = along - distance


_THICKEST = 5e-3  # m, of a layer that is filled: what is more is not the mesh's coarseness
_TRIES, _NEARER = 4, 0.8
_BESIDE = (0, 1, -1)  # columns
_NOT_FILLED = -1.0  # in place of how thick the layer is


class GelLayer:
    """Gel in the pixels in front of a coupled face that no tetrahedron covers."""

    def __init__(self, probe: Probe) -> None:
        line, distance = probe.pixel_beams
        self._row, self._column = np.nonzero(distance < _THICKEST)
        near = self._row, self._column
        self._line, self._distance = line[near], distance[near]
        numbers = np.arange(probe.lines)
        steps = probe.beam_directions / probe.pixel_spacing
        # Columns and rows per metre of depth along each pixel's beam.
        self._along = np.stack([np.interp(self._line, numbers, step) for step in steps.T])
        # A pixel that the surface crosses is not covered whole.
        self._margin = float(probe.pixel_spacing[1])
        # With the kernel loaded the first layer is not late.
        image = np.zeros((probe.rows, probe.columns), np.uint8)
        self.fill_gap(image, np.full(probe.lines, 1e-6), np.ones(probe.lines))

    def fill_gap(
        self, image: NDArray[np.uint8], gap: NDArray[np.float64], coupling: NDArray[np.floating]
    ) -> NDArray[np.uint8]:
        """Fill the layer of a slice (rows, columns); return the slice itself where there is none.

        Args:
            image: (rows, columns).
            gap: (lines,) m, from the face to the surface of the mesh along each line.
            coupling: (lines,); lines without stay as they are.
        """
        filled = (coupling > 0.0) & (gap <= _THICKEST)
        thick = np.where(filled, np.maximum(gap, 0.0), _NOT_FILLED)
        if not (thick > 0.0).any():
            return image
        out = image.copy()
        pixels = self._row, self._column, self._line, self._distance, self._along
        _mirror(image, *pixels, thick, self._margin, out)
        return out


@njit(cache=True, nogil=True, error_model="numpy")
def _mirror(image, row, column, line, distance, along, thick, margin, out):  # noqa: PLR0913
    """Set pixels of out (rows, columns) in the layer, thick (lines,) m where not negative.

    Shapes and units:
        row, column, line, distance: (P,) of the pixels, and where they are on their beams (m).
        along: (2, P), columns and rows per metre along these.
        margin: m, by which the layer counts as thicker.
    """
    rows, columns = image.shape
    last = len(thick) - 1
    for p in range(len(row)):
        at = min(max(line[p], 0.0), last)
        one = int(at)
        other = min(one + 1, last)
        near, far = thick[one], thick[other]
        if near < 0.0 or far < 0.0:
            near = far = near if at - one < 0.5 else far
            if near < 0.0:
                continue
        end = near + (at - one) * (far - near) + margin
        if distance[p] >= end:
            continue
        away = 2.0 * (end - distance[p])
        # At a fan's side the mirrored place may be beyond it: then one beside it, or nearer.
        for attempt in range(_TRIES * len(_BESIDE)):
            c = int(column[p] + away * along[0, p] + 0.5) + _BESIDE[attempt % len(_BESIDE)]
            r = int(row[p] + away * along[1, p] + 0.5)
            if 0 <= c < columns and 0 <= r < rows and image[r, c] > 0:
                out[row[p], column[p]] = image[r, c]
                break
            if attempt % len(_BESIDE) == len(_BESIDE) - 1:
                away *= _NEARER


BAND_SPACING = 1.2e-3
"""m: how thick a lens of 0.8 mm seems, which sound crosses at 1000 m/s instead of 1540."""

_BAND_LOSS = 5.0  # dB, of each passage
_BAND_LENGTH = 0.2e-3  # m, standard deviation of the first band
_BAND_GROWTH = 0.12  # of the length, with each passage
_HAZE = -26.0  # dB, of the haze at the face from the first band
_HAZE_LOSS = 1.0e3  # dB/m
_GRAIN = (512, 192)  # the haze's, along and across the beams
_PLACES = 1024  # along the face, at which coupling is tabulated
_STEPS = 32  # of depth, likewise
_F_NUMBER = 2.0  # depth over the length of face that looks there
_APERTURE = (1.5e-3, 1 / 3)  # m, and fraction of the face: the least and the most that forms a line
_FINEST = 4096  # entries of the table of losses
_GREYS_PER_DECIBEL = 255.0 / ECHO_RANGE
_SILENT = 255  # grey values of loss after which nothing is left


class Reverberation:
    """Weakens lines by their coupling, and shows the face's echoes in those with air."""

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        line, depth = np.nan_to_num(probe.pixel_beams)
        place = np.clip((line + 0.5) * (_PLACES / probe.lines), 0, _PLACES - 1)
        step = np.clip(depth * (_STEPS / probe.depth), 0, _STEPS - 1)
        self._place = place.astype(np.uint16) + step.astype(np.uint16) * np.uint16(_PLACES)
        self._air = _air_echoes(probe, imaging.reverberation)
        self._line = (np.arange(_PLACES) + 0.5) * (probe.lines / _PLACES) - 0.5
        self._reach = _apertures(probe) // 2
        # With the kernels loaded the first line that loses contact is not late.
        self.apply_coupling(
            np.zeros(self._place.shape, np.uint8), np.zeros(probe.lines, np.float32)
        )

    def apply_coupling(
        self, image: NDArray[np.uint8], coupling: NDArray[np.float32]
    ) -> NDArray[np.uint8]:
        """Return echo levels (rows, columns) as lines of this coupling (lines,) show them."""
        if coupling.min() >= 1.0:
            return image
        coupled = np.interp(self._line, np.arange(len(coupling)), coupling)
        losses = np.empty((_STEPS, _PLACES), dtype=np.uint32)
        _lose(np.sqrt(coupled), self._reach, _LOSSES, losses)
        out = np.empty_like(image)
        air, place = self._air.reshape(-1), self._place.reshape(-1)
        _brighter(image.reshape(-1), air, place, losses.reshape(-1), out.reshape(-1))
        return out


def _losses() -> NDArray[np.uint32]:
    """Return (`_FINEST` + 1,) grey values lost, there and back, at even amplitude fractions."""
    fraction = np.maximum(np.arange(_FINEST + 1), 0.1) / _FINEST
    lost = np.round(-40.0 * np.log10(fraction) * _GREYS_PER_DECIBEL)
    return np.minimum(lost, _SILENT).astype(np.uint32)


_LOSSES = _losses()


def _apertures(probe: Probe) -> NDArray[np.int64]:
    """Return (`_STEPS`,) lengths of face, in places, that form a line at each step of depth."""
    length = float(np.linalg.norm(np.diff(probe.beam_starts, axis=0), axis=1).sum())
    length = max(length * probe.lines / max(probe.lines - 1, 1), 1e-6)
    depth = (np.arange(_STEPS) + 0.5) * (probe.depth / _STEPS)
    least, most = _APERTURE
    part = np.maximum(np.minimum(depth / _F_NUMBER, most * length), least) / length
    return np.asarray(np.minimum(part, 1.0) * _PLACES).astype(np.int64)


def _air_echoes(probe: Probe, first: float) -> NDArray[np.uint8]:
    """Return (rows, columns) levels of a face in air, its first band at ``first`` dB."""
    line, depth = np.nan_to_num(probe.pixel_beams)
    # Elements differ a little, in the same manner in every frame.
    random = np.random.Generator(np.random.PCG64(7))
    samples, lines = _GRAIN
    grain = random.random(_GRAIN, dtype=np.float32)
    grain += np.roll(grain, 1, axis=1)
    sample = np.clip(depth * (samples / probe.depth), 0, samples - 1).astype(np.intp)
    element = np.clip((line + 0.5) * (lines / probe.lines), 0, lines - 1).astype(np.intp)
    texture = grain[sample, element]
    amplitude = 0.5 * texture * 10.0 ** ((_HAZE - _HAZE_LOSS * depth) / 20.0)
    for passage in range(1, 1 + int(ECHO_RANGE / _BAND_LOSS)):
        length = _BAND_LENGTH * (1.0 + _BAND_GROWTH * passage)
        away = (depth - (passage - 0.5) * BAND_SPACING) / length
        level = 10.0 ** (-_BAND_LOSS * (passage - 1) / 20.0)
        amplitude += (0.85 + 0.15 * texture) * level * np.exp(-0.5 * away * away)
    level = (first + ECHO_RANGE + 20.0 * np.log10(np.maximum(amplitude, 1e-6))) * _GREYS_PER_DECIBEL
    level[np.isnan(probe.pixel_beams[0])] = 0.0
    return np.clip(level + 0.5, 0.0, 255.0).astype(np.uint8)


@njit(cache=True, nogil=True, error_model="numpy")
def _lose(coupled, reach, losses, out):
    """Fill the losses of tissue and of the face's own echo, at each step of depth and place.

    Shapes and units:
        coupled: (places,) fraction of the amplitude transmitted in one direction.
        reach: (steps,) places on either side whose elements form a line.
        out: (steps, places), set: the tissue's loss, and that of the face's echo times 256.
    """
    places = len(coupled)
    finest = len(losses) - 1
    own = np.empty(places, dtype=np.uint32)
    total = np.zeros(places + 1)
    for i in range(places):
        total[i + 1] = total[i] + coupled[i]
    for step in range(len(reach)):
        for i in range(places):
            first, end = max(i - reach[step], 0), min(i + reach[step] + 1, places)
            mean = min((total[end] - total[first]) / (end - first), 1.0)
            if step == 0:
                # By the nearest elements; squared, since little contact already quiets the lens.
                own[i] = losses[np.int64((1.0 - mean * mean) ** 2 * finest + 0.5)] << 8
            out[step, i] = own[i] | losses[np.int64(mean * finest + 0.5)]


@njit(cache=True, nogil=True, error_model="numpy")
def _brighter(image, air, place, losses, out):
    """Fill out with the brighter of tissue and air (flat), each less its loss at its place."""
    for i in range(len(image)):
        loss = losses[place[i]]
        tissue = np.int32(image[i]) - np.int32(loss & 255)
        echo = np.int32(air[i]) - np.int32(loss >> 8)
        out[i] = max(tissue, echo, np.int32(0))
