"""Displacement and strain of the tissue in an image, without error, and the colours of strain.

Axial strain is the engineering strain of a line of tissue that lies along the beam *now*: its
length now over its length in the other state, less 1. A tissue line along the unit vector d was
1 / λ times as long in another state, with 1 / λ² = d · c d. The tensor c = F⁻ᵀ F⁻¹ is Cauchy's
deformation tensor (Holzapfel, *Nonlinear Solid Mechanics*, 2000, section 2.5); F maps that state to
now. It is constant in a linear tetrahedron, averaged at each node over its tetrahedra by their
volumes (Zienkiewicz and Zhu, Int. J. Numer. Methods Eng. 24:337, 1987), and linear in between.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.b_mode import BMode
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.slicing.strain import AxialStrain
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> from us_sim.volume.volume import Volume
>>> volume = Volume(np.zeros((41, 41, 41), np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
>>> mesh = box_mesh([0.0, 0.02, 0.04], [0.0, 0.04], [0.0, 0.04])
>>> scanner = BMode(volume, LinearProbe(aperture=0.01, depth=0.02, columns=2, rows=3))
>>> scanner.attach_mesh(mesh.nodes, mesh.tetrahedra)
>>> frame = scanner.make_frame(Pose([0.02, 0.02, 0.01]), mesh.nodes * [1.02, 1.02, 0.95])
>>> AxialStrain.from_frame(frame).compute_strain(frame)[:, 0].round(4)
array([-0.05, -0.05, -0.05], dtype=float32)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.kernels import njit
from us_sim.slicing.cutting.resampling import evaluate_affine, run_rows_in_parallel
from us_sim.slicing.cutting.section import compute_adjugate, is_solid
from us_sim.slicing.drawing.overlay import ColourScale
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import LinearProbe, Probe


def compute_displacement(frame: Frame) -> NDArray[np.float32]:
    """Compute (rows, columns, 2) m: the tissue's way from rest to each pixel, lateral and axial.

    These are its components along +x and +z of frame ``probe`` as the probe is now; the part across
    the image is left out. It is the way in frame ``patient``: the probe's own motion is no part of
    it. NaN where no tissue of the mesh is: outside it, where tissue has moved away, and beside the
    beams.

    Raises:
        MeshError: there is no mesh, another number of nodes than at rest, or nodes that are not
            finite.
        ProbeError: the pose is nowhere near.
    """
    located, plane = frame.located, frame.plane
    to_patient = frame.volume.index_to_patient
    now = np.stack([plane.origin, plane.column_step, plane.row_step], axis=1)
    rest = to_patient[:3, :3] @ located.maps[: len(located.tetrahedra)]
    rest[:, :, 0] += to_patient[:3, 3]
    across = frame.pose.rotation[:, [0, 2]].T
    return evaluate_affine(across @ (now - rest), located.elements, threads=frame.threads)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_nodal_deformation(  # noqa: PLR0913
    shown, tetrahedra, starts, members, before, now, to_pixel, pixel_volume, steps, place, deformed,
    done, mean,
):  # fmt: skip
    """Fill ``mean`` (N, 3) at the nodes of the tetrahedra that are shown.

    It is c in the image's plane: lateral by lateral, lateral by axial, axial by axial. A node
    around which all tetrahedra are inverted or flat is left without deformation: 1, 0, 1.

    Shapes and units:
        shown: (E,) numbers of tetrahedra. tetrahedra: (M, 4) nodes.
        starts, members: (N + 1,) and (4 M,), the tetrahedra around each node.
        before, now: (N, 3) m, nodes in the other state and now.
        to_pixel: (3, 4) from m to column, row and height. pixel_volume: m³ per unit of those.
        steps: (2,) m, from one column to the next, and from one row to the next.
        place: (N, 3) column, row and height of the nodes now, filled here.
        deformed: (M, 4) room for volume and c of tetrahedra. done: (M + N,) bool, room.
    """
    for n in range(len(now)):
        x, y, z = now[n, 0], now[n, 1], now[n, 2]
        for a in range(3):
            m = to_pixel[a]
            place[n, a] = m[3] + m[0] * x + m[1] * y + m[2] * z
    done[:] = False
    count = len(tetrahedra)
    for s in shown:
        for k in range(4):
            n = tetrahedra[s, k]
            if done[count + n]:
                continue
            done[count + n] = True
            volume = first = mixed = last = 0.0
            for q in range(starts[n], starts[n + 1]):
                e = members[q]
                if not done[e]:
                    done[e] = True
                    _deform(tetrahedra, e, before, place, pixel_volume, steps, deformed)
                volume += deformed[e, 0]
                first += deformed[e, 0] * deformed[e, 1]
                mixed += deformed[e, 0] * deformed[e, 2]
                last += deformed[e, 0] * deformed[e, 3]
            mean[n, 0] = first / volume if volume > 0.0 else 1.0
            mean[n, 1] = mixed / volume if volume > 0.0 else 0.0
            mean[n, 2] = last / volume if volume > 0.0 else 1.0


@njit(inline="always", error_model="numpy")
def _deform(tetrahedra, e, before, place, pixel_volume, steps, deformed):
    """Fill a tetrahedron's row: its volume now in any unit (0 if it is not solid), and c."""
    n0, n1, n2, n3 = tetrahedra[e, 0], tetrahedra[e, 1], tetrahedra[e, 2], tetrahedra[e, 3]
    size, to_1, to_2, to_3 = compute_adjugate(place, n0, n1, n2, n3)
    ax = before[n1, 0] - before[n0, 0]
    ay = before[n1, 1] - before[n0, 1]
    az = before[n1, 2] - before[n0, 2]
    bx = before[n2, 0] - before[n0, 0]
    by = before[n2, 1] - before[n0, 1]
    bz = before[n2, 2] - before[n0, 2]
    cx = before[n3, 0] - before[n0, 0]
    cy = before[n3, 1] - before[n0, 1]
    cz = before[n3, 2] - before[n0, 2]
    earlier = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    if not is_solid(size, pixel_volume, earlier):
        deformed[e] = 0.0
        return
    # How fast the place in the other state changes along the image's columns and rows.
    p = 1.0 / (size * steps[0])
    ux = p * (to_1[1] * ax + to_2[1] * bx + to_3[1] * cx)
    uy = p * (to_1[1] * ay + to_2[1] * by + to_3[1] * cy)
    uz = p * (to_1[1] * az + to_2[1] * bz + to_3[1] * cz)
    r = 1.0 / (size * steps[1])
    wx = r * (to_1[2] * ax + to_2[2] * bx + to_3[2] * cx)
    wy = r * (to_1[2] * ay + to_2[2] * by + to_3[2] * cy)
    wz = r * (to_1[2] * az + to_2[2] * bz + to_3[2] * cz)
    deformed[e, 0] = abs(size)
    deformed[e, 1] = ux * ux + uy * uy + uz * uz
    deformed[e, 2] = ux * wx + uy * wy + uz * wz
    deformed[e, 3] = wx * wx + wy * wy + wz * wz


@njit(cache=True, nogil=True, error_model="numpy")
def fill_pixel_maps(shown, tetrahedra, place, mean, maps):
    """Fill ``maps`` (E, 3, 3): coefficients of (1, column, row) of the nodes' values.

    Shapes and units:
        shown: (E,) numbers of tetrahedra. tetrahedra: (M, 4) nodes.
        place: (N, 3) column, row and height of the nodes.
        mean: (N, 3), as `fill_nodal_deformation` fills it.
    """
    for s in range(len(shown)):
        e = shown[s]
        n0, n1, n2, n3 = tetrahedra[e, 0], tetrahedra[e, 1], tetrahedra[e, 2], tetrahedra[e, 3]
        size, to_1, to_2, to_3 = compute_adjugate(place, n0, n1, n2, n3)
        r = 1.0 / size
        for k in range(3):
            at = mean[n0, k]
            b = r * (mean[n1, k] - at)
            c = r * (mean[n2, k] - at)
            d = r * (mean[n3, k] - at)
            maps[s, k, 0] = at + b * to_1[0] + c * to_2[0] + d * to_3[0]
            maps[s, k, 1] = b * to_1[1] + c * to_2[1] + d * to_3[1]
            maps[s, k, 2] = b * to_1[2] + c * to_2[2] + d * to_3[2]


class AxialStrain:
    """Strain images of a mesh's deformations.

    Args:
        rest_nodes: (N, 3) m. tetrahedra: (M, 4) indices into them.
    """

    def __init__(self, rest_nodes: ArrayLike, tetrahedra: ArrayLike) -> None:
        self._rest = np.array(rest_nodes, dtype=np.float64)
        self._tetrahedra = np.array(tetrahedra, dtype=np.int32)
        nodes, count = self._rest.shape, len(self._tetrahedra)
        corners = self._tetrahedra.ravel()
        self._starts = np.zeros(nodes[0] + 1, dtype=np.int64)
        np.cumsum(np.bincount(corners, minlength=nodes[0]), out=self._starts[1:])
        self._members = (np.argsort(corners, kind="stable") // 4).astype(np.int32)
        self._now, self._before, self._place = np.empty(nodes), np.empty(nodes), np.empty(nodes)
        self._mean = np.empty(nodes)
        self._deformed = np.empty((count, 4))
        self._done = np.empty(count + nodes[0], dtype=np.bool_)
        self._directions: tuple[Probe, NDArray[np.float32]] | None = None

    @classmethod
    def from_frame(cls, frame: Frame) -> AxialStrain:
        """Make the strain of the mesh that carries the volume in a frame.

        Raises:
            MeshError: there is none.
        """
        if frame.mesh is None:
            raise MeshError("no tissue carries the volume, so there is no strain")
        return cls(*frame.mesh)

    def compute_strain(
        self, frame: Frame, before: NDArray[np.float64] | None = None
    ) -> NDArray[np.float32]:
        """Compute the strain (rows, columns) along each pixel's beam, negative where it shortens.

        Args:
            frame: the image.
            before: (N, 3) m, where the nodes were; None for at rest.

        Returns:
            NaN where no tissue of the mesh is, and beside the beams.

        Raises:
            MeshError: the frame has no mesh or another, or nodes of either state are not as many
                as this mesh has.
            ProbeError: the pose is nowhere near.
        """
        located, plane = frame.located, frame.plane
        now = self._copy_nodes(frame.nodes, self._now)
        then = self._rest if before is None else self._copy_nodes(before, self._before)
        shown = located.tetrahedra
        fill_nodal_deformation(
            shown, self._tetrahedra, self._starts, self._members, then, now, plane.to_pixel,
            float(np.linalg.det(plane.basis)), frame.probe.pixel_spacing, self._place,
            self._deformed, self._done, self._mean,
        )  # fmt: skip
        maps = np.empty((len(shown), 3, 3))
        fill_pixel_maps(shown, self._tetrahedra, self._place, self._mean, maps)
        values = np.empty(located.elements.shape, dtype=np.float32)
        elements, directions = located.elements, self._directions_of(frame.probe)
        run_rows_in_parallel(
            frame.threads,
            plane.rows,
            lambda first, end: _strain(maps, elements, directions, first, end, values),
        )
        return values

    def _copy_nodes(self, nodes: ArrayLike | None, room: NDArray[np.float64]) -> Any:
        array = np.asarray(nodes)
        if array.shape != room.shape:
            raise MeshError(
                f"the strain is that of a mesh of {len(room)} nodes, but {array.shape} came"
            )
        room[:] = array
        return room

    def _directions_of(self, probe: Probe) -> NDArray[np.float32]:
        """Return `Probe.pixel_directions`; one row and column where all beams are parallel."""
        if self._directions is None or self._directions[0] is not probe:
            directions = probe.pixel_directions
            if isinstance(probe, LinearProbe):
                directions = directions[:, :1, :1]
            self._directions = probe, np.array(directions)
        return self._directions[1]


@njit(cache=True, nogil=True, error_model="numpy")
def _strain(maps, elements, directions, first_row, end_row, values):
    """Fill rows of ``values`` (rows, columns) a run of pixels of one tetrahedron at a time.

    Shapes and units:
        maps: (E, 3, 3) as `fill_pixel_maps` fills them. elements: (rows, columns).
        directions: (2, rows, columns) x and z of each pixel's beam, or (2, 1, 1) for 0 and 1.
    """
    columns = elements.shape[1]
    along_z = directions.shape[1] == 1 and directions.shape[2] == 1
    one = np.float32(1.0)
    for row in range(first_row, end_row):
        line = elements[row]
        start = 0
        while start < columns:
            element = line[start]
            end = start + 1
            while end < columns and line[end] == element:
                end += 1
            if element < 0 or element >= len(maps):
                for i in range(start, end):
                    values[row, i] = np.nan
                start = end
                continue
            m = maps[element]
            axial = np.float32(m[2, 0] + m[2, 2] * row)
            d_axial = np.float32(m[2, 1])
            if along_z:
                for i in range(start, end):
                    values[row, i] = one / np.sqrt(axial + d_axial * np.float32(i)) - one
            else:
                lateral = np.float32(m[0, 0] + m[0, 2] * row)
                d_lateral = np.float32(m[0, 1])
                mixed = np.float32(m[1, 0] + m[1, 2] * row)
                d_mixed = np.float32(m[1, 1])
                for i in range(start, end):
                    at = np.float32(i)
                    x = directions[0, row, i]
                    z = directions[1, row, i]
                    values[row, i] = one / np.sqrt(
                        x * x * (lateral + d_lateral * at)
                        + np.float32(2.0) * x * z * (mixed + d_mixed * at)
                        + z * z * (axial + d_axial * at)
                    ) - one  # fmt: skip
            start = end


class ImageCompression(NamedTuple):
    """Mean strain and evenness of all tissue in a strain image."""

    mean: float  # strain, negative where the tissue got shorter; 0 without tissue
    quality: float
    """0 to 1: the mean over the root mean square.

    It is 1 where all tissue is strained alike, and falls where the press slides, turns or lets go
    one part while it presses another. With the signal-to-noise ratio of an elastogram, its mean
    over its standard deviation (Céspedes and Ophir, Ultrasonic Imaging 15:73, 1993), it is
    SNR / √(1 + SNR²): what an even press makes of the image, and not how well it can be tracked.
    """


def measure_compression(strain: NDArray[np.floating]) -> ImageCompression:
    """Measure the compression in an image (any shape) of strain, NaN where there is no tissue."""
    there = strain[np.isfinite(strain)].astype(np.float64)
    if not there.size:
        return ImageCompression(0.0, 0.0)
    mean, square = float(there.mean()), float(np.square(there).mean())
    return ImageCompression(mean, abs(mean) / square**0.5 if square > 0.0 else 0.0)


_COLOURS = ((215, 48, 39), (253, 174, 97), (48, 48, 48), (116, 173, 209), (69, 117, 180))
_ENDS = tuple(step / power for power in (100, 10, 1) for step in (1, 2, 3, 5))
"""Round values at which a bar may end; strain beyond the last has its colour."""
_HELD = 95.0  # percent of the pixels that lie within the bar; a vein that collapses need not
_STAYS = 0.4  # the bar's end stays until strain is less than this much of it
_STEP = 4  # pixels from one that is looked at to the next


class AdaptiveScale:
    """The strain at the ends of a bar that holds nearly all of an image, and seldom changes."""

    def __init__(self) -> None:
        self._end = 0.0

    def update_end(self, values: NDArray[np.floating]) -> float:
        """Return the bar's end for an image (rows, columns), NaN where there is no strain."""
        sizes = np.abs(values[::_STEP, ::_STEP])
        sizes = sizes[np.isfinite(sizes)]
        most = float(np.percentile(sizes, _HELD)) if sizes.size else 0.0
        if not _STAYS * self._end < most <= self._end:
            self._end = next((end for end in _ENDS if most <= end), _ENDS[-1])
        return self._end


def make_strain_scale(name: str, most: float) -> ColourScale:
    """Make colours from -most to most, in percent; red and blue suit colour-blind eyes, too."""
    title = name.replace("_", " ")
    return ColourScale(title, -most, most, "%", factor=100.0, colours=_COLOURS)
