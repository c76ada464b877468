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
>>> scanner.carry(mesh.nodes, mesh.tetrahedra)
>>> frame = scanner.frame(Pose([0.02, 0.02, 0.01]), mesh.nodes * [1.02, 1.02, 0.95])
>>> AxialStrain.of(frame).image(frame)[:, 0].round(4)
array([-0.05, -0.05, -0.05], dtype=float32)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from us_sim.errors import MeshError
from us_sim.slicing.cutting.resampling import evaluate
from us_sim.slicing.cutting.section import FLAT
from us_sim.slicing.drawing.overlay import ColourScale
from us_sim.slicing.frame import Frame
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


def displacement(frame: Frame) -> NDArray[np.float32]:
    """(rows, columns, 2) m: the tissue's way from rest to each pixel, lateral and axial.

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
    return evaluate(across @ (now - rest), located.elements, threads=frame.threads)


class AxialStrain:
    """Strain images of a mesh's deformations.

    Args:
        rest_nodes: (N, 3) m. tetrahedra: (M, 4) indices into them.
        tissue: (M,) which tissue each is of, at least 0: strain is averaged at the nodes of one
            tissue only. None is one for all.
    """

    def __init__(
        self,
        rest_nodes: ArrayLike,
        tetrahedra: ArrayLike,
        tissue: NDArray[np.integer] | None = None,
    ) -> None:
        self._rest = np.array(rest_nodes, dtype=np.float64)
        self._tetrahedra = np.array(tetrahedra, dtype=np.int64)
        shape, count = self._tetrahedra.shape, len(self._tetrahedra)
        keys = self._tetrahedra
        if tissue is not None:  # a node between two tissues is two corners
            keys = keys * (int(tissue.max(initial=0)) + 1) + tissue.astype(np.int64)[:, None]
        numbers = np.unique(keys.ravel(), return_inverse=True)[1].ravel()
        self._corners = numbers.reshape(shape)  # (M, 4)
        ends = np.arange(0, numbers.size + 1, 4)
        # (corners, M), which tetrahedra are around each corner.
        self._around = csr_array((np.ones(numbers.size), numbers, ends), (count, numbers.max() + 1))
        self._around = self._around.T.tocsr()

    @classmethod
    def of(cls, frame: Frame, *, sharp: bool = False) -> AxialStrain:
        """The strain of the mesh that carries the volume in a frame.

        Args:
            sharp: average nothing over borders of the volume's labels, as far as the mesh follows
                them.

        Raises:
            MeshError: there is none.
        """
        if frame.mesh is None:
            raise MeshError("no tissue carries the volume, so there is no strain")
        tissue = None
        if sharp and frame.volume.labels is not None:
            from us_sim.tissue.elasticity.materials import label_fractions  # for strain alone

            mesh, volume = TetrahedralMesh(*frame.mesh), frame.volume
            found = label_fractions(mesh, frame.volume.labels, volume.patient_to_index)
            tissue = found.labels[found.fractions.argmax(axis=1)]
        return cls(*frame.mesh, tissue)

    def image(self, frame: Frame, before: NDArray[np.float64] | None = None) -> NDArray[np.float32]:
        """(rows, columns): the strain along each pixel's beam, negative where tissue got shorter.

        Args:
            before: (N, 3) m, where the nodes were; None for at rest.

        Returns:
            NaN where no tissue of the mesh is, and beside the beams.

        Raises:
            MeshError: the frame has no mesh or another, or nodes of either state are not as many
                as this mesh has.
            ProbeError: the pose is nowhere near.
        """
        located, to_pixel = frame.located, frame.plane.to_pixel
        now = self._require_nodes(frame.nodes)
        then = self._rest if before is None else self._require_nodes(before)
        place = now @ to_pixel[:, :3].T + to_pixel[:, 3]  # (N, 3) column, row and height
        numbers = self._corners[located.tetrahedra]
        corners, corner = np.unique(numbers, return_inverse=True)
        mean = self._average(corners, then, place, frame)[corner.reshape(numbers.shape)]
        edges, origin = _edges(place, self._tetrahedra[located.tetrahedra])
        size, inverse = _inverted(edges)
        slopes = inverse / size[:, None, None] @ (mean[:, 1:] - mean[:, :1])  # (E, 3, 3)
        constant = mean[:, 0] - np.einsum("ea,eak->ek", origin, slopes)
        maps = np.stack([constant, slopes[:, 0], slopes[:, 1]], axis=2)
        first, mixed, last = np.moveaxis(
            evaluate(maps, located.elements, threads=frame.threads), 2, 0
        )
        x, z = frame.probe.pixel_directions
        one = np.float32(1.0)
        return np.asarray(one / np.sqrt(x * (x * first + 2 * z * mixed) + z * z * last) - one)

    def _average(
        self,
        corners: NDArray[np.integer],
        then: NDArray[np.float64],
        place: NDArray[np.float64],
        frame: Frame,
    ) -> NDArray[np.float64]:
        """(K, 3) of c at corners: lateral by lateral, lateral by axial, axial by axial.

        A corner around which all tetrahedra are inverted or flat is without deformation: 1, 0, 1.
        """
        around = self._around[corners]
        used, column = np.unique(around.indices, return_inverse=True)
        edges, _ = _edges(place, self._tetrahedra[used])
        before, _ = _edges(then, self._tetrahedra[used])
        size, inverse = _inverted(edges)
        earlier, _ = _inverted(before)
        pixel = float(np.linalg.det(frame.plane.basis))  # m³ per unit of size
        is_solid = size * pixel * np.sign(earlier) > FLAT * np.abs(earlier)
        volume = np.where(is_solid, np.abs(size), 0.0)
        steps = frame.probe.pixel_spacing
        safe = np.where(volume > 0.0, size, 1.0)[:, None]
        # How fast the place in the other state changes along the image's columns and rows.
        lateral, axial = ((inverse[:, a, None] @ before)[:, 0] / (safe * steps[a]) for a in (0, 1))
        c = np.stack(
            [(one * other).sum(axis=1) for one, other in
             ((lateral, lateral), (lateral, axial), (axial, axial))], axis=1
        )  # fmt: skip
        weights = csr_array((volume[column], column, around.indptr), (len(corners), len(used)))
        total = weights.sum(axis=1)[:, None]
        whole = np.array([1.0, 0.0, 1.0])
        return np.asarray(np.where(total > 0.0, weights @ c / np.maximum(total, 1e-300), whole))

    def _require_nodes(self, nodes: ArrayLike | None) -> NDArray[np.float64]:
        array = np.asarray(nodes)
        if array.shape != self._rest.shape:
            raise MeshError(
                f"the strain is that of a mesh of {len(self._rest)} nodes, but {array.shape} came"
            )
        return np.asarray(array, dtype=np.float64)


def _edges(
    place: NDArray[np.float64], tetrahedra: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(E, 3, 3), from the first corner of each tetrahedron to the others; (E, 3), that corner."""
    corners = place[tetrahedra]
    return corners[:, 1:] - corners[:, :1], corners[:, 0]


def _inverted(edges: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Determinants (E,) of matrices (E, 3, 3), and their inverses times these."""
    a, b, c = np.moveaxis(edges, 1, 0)
    columns = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    return np.einsum("ea,ea->e", a, columns[:, :, 0]), columns


class Compression(NamedTuple):
    """Mean strain and evenness of all tissue in a strain image."""

    mean: float  # strain, negative where the tissue got shorter; 0 without tissue
    quality: float
    """0 to 1: the mean over the root mean square.

    It is 1 where all tissue is strained alike, and falls where the press slides, turns or lets go
    one part while it presses another. With the signal-to-noise ratio of an elastogram, its mean
    over its standard deviation (Céspedes and Ophir, Ultrasonic Imaging 15:73, 1993), it is
    SNR / √(1 + SNR²): what an even press makes of the image, and not how well it can be tracked.
    """


def compression(strain: NDArray[np.floating]) -> Compression:
    """The compression of an image (any shape) of strain, NaN where there is no tissue."""
    there = strain[np.isfinite(strain)].astype(np.float64)
    if not there.size:
        return Compression(0.0, 0.0)
    mean, square = float(there.mean()), float(np.square(there).mean())
    return Compression(mean, abs(mean) / square**0.5 if square > 0.0 else 0.0)


_COLOURS = ((215, 48, 39), (253, 174, 97), (48, 48, 48), (116, 173, 209), (69, 117, 180))
_ENDS = tuple(step / power for power in (100, 10, 1) for step in (1, 2, 3, 5))
"""Round values at which a bar may end; strain beyond the last has its colour."""
_HELD = 95.0  # percent of the pixels that lie within the bar; a vein that collapses need not
_STAYS = 0.4  # the bar's end stays until strain is less than this much of it
_STEP = 4  # pixels from one that is looked at to the next


class FollowingEnd:
    """The strain at the ends of a bar that holds nearly all of an image, and seldom changes."""

    def __init__(self) -> None:
        self._end = 0.0

    def of(self, values: NDArray[np.floating]) -> float:
        """The end for an image (rows, columns), NaN where there is no strain."""
        sizes = np.abs(values[::_STEP, ::_STEP])
        sizes = sizes[np.isfinite(sizes)]
        most = float(np.percentile(sizes, _HELD)) if sizes.size else 0.0
        if not _STAYS * self._end < most <= self._end:
            self._end = next((end for end in _ENDS if most <= end), _ENDS[-1])
        return self._end


def strain_scale(name: str, most: float) -> ColourScale:
    """Colours from -most to most, in percent; red and blue differ to colour-blind eyes, too."""
    title = name.replace("_", " ")
    return ColourScale(title, -most, most, "%", factor=100.0, colours=_COLOURS)
