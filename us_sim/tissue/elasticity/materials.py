"""Elastic constants of a mesh's tetrahedra, from one material or from labelled voxels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.kernels import njit
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

# Samples of each tetrahedron: enough to measure a volume fraction to about one percent.
_SAMPLES = 1024


@dataclass(frozen=True, eq=False)
class TissueMaterials:
    """Constants of each tetrahedron of a mesh.

    Raises:
        MeshError: different lengths, or a constant that is not physical.
    """

    young_modulus: NDArray[np.float64]  # (M,), Pa
    poisson_ratio: NDArray[np.float64]  # (M,)
    density: NDArray[np.float64]  # (M,), kg/m3
    lumen_fraction: NDArray[np.float64] = field(
        default_factory=lambda: np.zeros(0)
    )  # (M,), of the volume
    lumen_pressure: NDArray[np.float64] = field(
        default_factory=lambda: np.zeros(0)
    )  # (M,), Pa, 0 without lumen

    def __post_init__(self) -> None:
        for name in vars(self):
            values = np.array(getattr(self, name), dtype=np.float64)
            if name.startswith("lumen") and values.size == 0:
                values = np.zeros(len(self.young_modulus))
            if values.ndim != 1 or len(values) != len(self.young_modulus):
                raise MeshError(f"{name} needs one number for each tetrahedron")
            object.__setattr__(self, name, values)
        unphysical = {
            "young_modulus": ~(np.isfinite(self.young_modulus) & (self.young_modulus > 0)),
            "poisson_ratio": ~((self.poisson_ratio > -1) & (self.poisson_ratio < 0.5)),
            "density": ~(np.isfinite(self.density) & (self.density > 0)),
        }
        for name, bad in unphysical.items():
            if bad.any():
                where = int(np.flatnonzero(bad)[0])
                others = f" and of {bad.sum() - 1} others" if bad.sum() > 1 else ""
                raise MeshError(
                    f"{name} of tetrahedron {where}{others} is out of range, "
                    f"{getattr(self, name)[where]:g}: moduli and densities are above zero, "
                    f"Poisson's ratio is above -1 and below 0.5"
                )
        hollow = self.lumen_fraction > 0
        wrong = ~((self.lumen_fraction >= 0) & (self.lumen_fraction <= 1))
        wrong |= ~(np.isfinite(self.lumen_pressure) & ((self.lumen_pressure > 0) == hollow))
        if wrong.any():
            where = int(np.flatnonzero(wrong)[0])
            raise MeshError(
                f"tetrahedron {where} has a lumen of {self.lumen_fraction[where]:g} of its volume "
                f"at {self.lumen_pressure[where]:g} Pa: fractions are 0 to 1, and pressures above "
                f"zero where there is a lumen, and zero elsewhere"
            )


def make_uniform_materials(mesh: TetrahedralMesh, material: Material) -> TissueMaterials:
    """Give all tetrahedra the same material."""
    count = len(mesh.tetrahedra)
    pressure = material.lumen_pressure
    return TissueMaterials(
        np.full(count, material.young_modulus),
        np.full(count, material.poisson_ratio),
        np.full(count, material.density),
        np.full(count, float(pressure is not None)),
        np.full(count, pressure or 0.0),
    )


class LabelFractions(NamedTuple):
    """Fractions of each tetrahedron that each label fills."""

    labels: NDArray[np.uint8]  # (L,) those that occur, ascending
    fractions: NDArray[np.float64]  # (M, L) of the volume; rows sum to 1

    def for_label(self, label: int) -> NDArray[np.float64]:
        """Return (M,) fractions of one label, zero where it does not occur."""
        return self.fractions[:, self.labels == label].sum(axis=1)


def label_fractions(
    mesh: TetrahedralMesh, labels: NDArray[np.uint8], index_from_patient: NDArray[np.float64]
) -> LabelFractions:
    """Measure the volume fraction of each label in each tetrahedron.

    The same 1024 low-discrepancy points (Kronecker sequence of the generalised golden ratio, mapped
    to the simplex by sorting) are looked up in every tetrahedron, so that a tetrahedron smaller
    than a voxel is served as well as one of a thousand voxels. Points beyond the volume take the
    nearest voxel.

    Args:
        mesh: in frame ``patient``.
        labels: (i, j, k).
        index_from_patient: (4, 4) affine, patient metres to voxel indices (centres at integers).

    Raises:
        MeshError: the labels are not a 3-D uint8 array, the map is not affine, or the mesh and
            the labels do not overlap.
    """
    if labels.ndim != 3 or labels.dtype != np.uint8 or 0 in labels.shape:
        raise MeshError(
            f"labels are {labels.dtype} of shape {labels.shape}: give a 3-D uint8 array"
        )
    affine = np.ascontiguousarray(index_from_patient, dtype=np.float64)
    if affine.shape != (4, 4) or not np.isfinite(affine).all():
        raise MeshError("index_from_patient must be a finite 4x4 affine matrix")
    indices = mesh.nodes @ affine[:3, :3].T + affine[:3, 3]
    last = np.array(labels.shape) - 0.5
    if (indices.max(axis=0) < -0.5).any() or (indices.min(axis=0) > last).any():
        raise MeshError(
            f"the mesh lies outside the labelled volume: its voxel indices run from "
            f"{indices.min(axis=0).round(1).tolist()} to {indices.max(axis=0).round(1).tolist()}, "
            f"the volume has shape {list(labels.shape)}"
        )
    labels = labels.view()
    labels.flags.writeable = False  # as a volume's are, or numba would compile the kernel twice
    counts = _count_labels(indices, mesh.tetrahedra, labels, _simplex_points(_SAMPLES))
    present = np.flatnonzero(counts.any(axis=0))
    return LabelFractions(present.astype(np.uint8), counts[:, present] / _SAMPLES)


def average_over_labels(
    fractions: LabelFractions, materials: Mapping[int, Material]
) -> TissueMaterials:
    """Average the constants of each tetrahedron's labels by volume fraction.

    Args:
        fractions: of each label in each tetrahedron.
        materials: of each label that occurs.

    Raises:
        MeshError: a label that occurs has no material.
    """
    missing = [int(label) for label in fractions.labels if int(label) not in materials]
    if missing:
        raise MeshError(
            f"label {missing[0]} fills {fractions.for_label(missing[0]).sum():.2f} tetrahedra "
            f"but has no material: add one for it"
        )
    constants = np.array(
        [
            (
                m.young_modulus,
                m.poisson_ratio,
                m.density,
                float(m.lumen_pressure is not None),
                m.lumen_pressure or 0.0,
            )
            for m in (materials[int(label)] for label in fractions.labels)
        ]
    )
    averages = (fractions.fractions @ constants).T
    young_modulus, poisson_ratio, density, lumen, pressure = averages
    np.divide(pressure, lumen, out=pressure, where=lumen > 0)  # of the lumen alone
    return TissueMaterials(young_modulus, poisson_ratio, density, lumen, pressure)


def _simplex_points(count: int) -> NDArray[np.float64]:
    """Return (count, 4) barycentric coordinates spread evenly over a tetrahedron.

    Points of the unit cube from M. Roberts' R3 sequence; the gaps between the sorted coordinates
    of a uniform point are uniform on the simplex (Devroye 1986, V.3).
    """
    golden = 1.2207440846057596  # the real root of x**4 = x + 1
    steps = golden ** -np.arange(1.0, 4.0)
    cube = np.sort((0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0, axis=1)
    return np.diff(cube, axis=1, prepend=0.0, append=1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _count_labels(indices, tetrahedra, labels, points):
    """Return (M, 256), the number of points (P, 4) of each tetrahedron in each label.

    indices (N, 3) are the nodes' voxel indices, labels (i, j, k).
    """
    counts = np.zeros((len(tetrahedra), 256), dtype=np.int32)
    top = np.array([labels.shape[0] - 1, labels.shape[1] - 1, labels.shape[2] - 1])
    voxel = np.empty(3, dtype=np.int64)
    for t in range(len(tetrahedra)):
        for p in range(len(points)):
            for axis in range(3):
                value = 0.5
                for corner in range(4):
                    value += points[p, corner] * indices[tetrahedra[t, corner], axis]
                voxel[axis] = min(max(int(np.floor(value)), 0), top[axis])
            counts[t, labels[voxel[0], voxel[1], voxel[2]]] += 1
    return counts


# lambda + mu over mu at Poisson's ratio 0.4: up to there linear tetrahedra do not lock.
_ELEMENT_LIMIT = 5.0


@dataclass(frozen=True, eq=False)
class VolumetricSplit:
    """Shear modulus mu, and lambda + mu in two parts, of each tetrahedron.

    A mesh has about five times as many linear tetrahedra as nodes: were each to keep its volume,
    nothing could move. So the bulk stiffness beyond a moderate one resists only the average change
    of volume around each node (J. Bonet and A. J. Burton, A simple average nodal pressure
    tetrahedral element, Commun. Numer. Meth. Engng. 14, 1998); the moderate part stabilises the
    pressures (M. A. Puso and J. Solberg, A stabilized nodally integrated tetrahedral, Int. J.
    Numer. Meth. Engng. 67, 2006).
    """

    shear: NDArray[np.float64]  # (M,), Pa
    element: NDArray[np.float64]  # (M,), Pa, resists the tetrahedron's own change of volume
    nodal: NDArray[np.float64]  # (M,), Pa, resists the average change of volume around its nodes


def volumetric_split(materials: TissueMaterials) -> VolumetricSplit:
    """Split lambda + mu, the coefficient of (J - 1)^2 / 2 in a stable neo-Hookean energy.

    (B. Smith, F. de Goes and T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Trans. Graph. 37,
    2018, without its logarithmic barrier.)
    """
    ratio = materials.poisson_ratio
    shear = materials.young_modulus / (2 * (1 + ratio))
    whole = shear / (1 - 2 * ratio)
    limit = _ELEMENT_LIMIT * shear
    # At the limit itself rounding must not leave the nodes any stiffness.
    element = np.where(whole > limit * (1 + 1e-9), limit, whole)
    return VolumetricSplit(shear, element, whole - element)
