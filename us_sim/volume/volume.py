"""A volume of grey values placed in frame ``patient``, and labels of its voxels."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.structure_names import Colour, choose_colours


@dataclass(frozen=True, eq=False)
class Volume:
    """Grey values on a regular grid; the centre of voxel (i, j, k) lies at that whole index.

    The arrays are kept as read-only views, without a copy where they are already C-contiguous,
    so several processes can use one memory-mapped volume.

    Raises:
        VolumeError: an array is not three-dimensional uint8, the two shapes differ, an axis has
            no voxel, or the affine is not finite or not invertible.

    Examples:
        >>> grey = np.zeros((40, 30, 20), np.uint8)
        >>> volume = Volume(grey, index_to_patient=np.diag([1e-3, 1e-3, 1e-3, 1.0]))
        >>> volume.shape, volume.label_names
        ((40, 30, 20), {})
    """

    intensities: NDArray[np.uint8]  # (i, j, k), axis 0 along the grid's x
    index_to_patient: NDArray[np.float64]  # (4, 4) affine, m; it may be oblique or mirrored
    labels: NDArray[np.uint8] | None = None  # (i, j, k), the structure of each voxel
    label_names: Mapping[int, str] = field(default_factory=dict)  # by number; 0 needs no name

    def __post_init__(self) -> None:
        object.__setattr__(self, "intensities", _voxels(self.intensities, "intensities"))
        if self.labels is not None:
            object.__setattr__(self, "labels", _voxels(self.labels, "labels"))
            if self.labels.shape != self.intensities.shape:
                raise VolumeError(
                    f"the labels {self.labels.shape} and the intensities {self.intensities.shape} "
                    f"of a volume must have the same shape"
                )
        object.__setattr__(self, "index_to_patient", _affine(self.index_to_patient))
        object.__setattr__(self, "label_names", dict(self.label_names))

    @property
    def shape(self) -> tuple[int, int, int]:
        """The number of voxels along each axis."""
        i, j, k = self.intensities.shape
        return i, j, k

    @cached_property
    def patient_to_index(self) -> NDArray[np.float64]:
        """(4, 4) affine from frame ``patient``, m, to voxel indices."""
        inverse = np.asarray(np.linalg.inv(self.index_to_patient), dtype=np.float64)
        inverse.flags.writeable = False
        return inverse

    @cached_property
    def extent(self) -> NDArray[np.float64]:
        """(2, 3) m, lower and upper corner of the box in ``patient`` around all voxels' faces."""
        extent = compute_grid_extent(self.index_to_patient, self.shape)
        extent.flags.writeable = False
        return extent

    def compute_centres(self, voxels: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the centres (N, 3) m of marked voxels (i, j, k), in frame ``patient``."""
        matrix = self.index_to_patient
        return np.asarray(np.argwhere(voxels) @ matrix[:3, :3].T + matrix[:3, 3])


def compute_grid_extent(
    index_to_patient: NDArray[np.float64], shape: tuple[int, int, int]
) -> NDArray[np.float64]:
    """(2, 3) m, lower and upper corner of the box in ``patient`` around a grid's voxels."""
    faces = np.stack([np.full(3, -0.5), np.array(shape) - 0.5])
    corners = np.stack(np.meshgrid(*faces.T, indexing="ij"), axis=-1).reshape(-1, 3)
    placed = corners @ index_to_patient[:3, :3].T + index_to_patient[:3, 3]
    return np.stack([placed.min(axis=0), placed.max(axis=0)])


def _voxels(array: NDArray[np.uint8], what: str) -> NDArray[np.uint8]:
    array = np.asarray(array)
    if array.ndim != 3 or array.dtype != np.uint8 or not array.size:
        raise VolumeError(
            f"the {what} of a volume must be three-dimensional uint8 with a voxel or more along "
            f"each axis, not {array.dtype} of the shape {array.shape}"
        )
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


def _affine(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.array(matrix, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or list(matrix[3]) != [0, 0, 0, 1]:
        raise VolumeError("index_to_patient must be a finite 4×4 matrix with the last row 0 0 0 1")
    steps = np.linalg.norm(matrix[:3, :3], axis=0)
    # Relative to the voxel's size, since a determinant in cubic metres is always tiny.
    if not steps.all() or abs(np.linalg.det(matrix[:3, :3] / steps)) < 1e-6:
        raise VolumeError("index_to_patient is singular: its axes span no volume")
    matrix.flags.writeable = False
    return matrix


@dataclass(frozen=True, eq=False)
class LabelMap:
    """Labels on the grid of some volume; 0 is in no structure."""

    labels: NDArray[np.uint8]  # (i, j, k)
    names: Mapping[int, str]
    colours: Mapping[int, Colour] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  # on how they came about, a sentence each

    def __post_init__(self) -> None:
        usual = choose_colours(self.names.values())
        colours = {n: self.colours.get(n) or usual[name] for n, name in self.names.items()}
        object.__setattr__(self, "colours", colours)

    @cached_property
    def voxels(self) -> dict[str, int]:
        """The number of voxels of each structure, by name."""
        # A slice at a time, since bincount would make 64-bit numbers of all voxels at once.
        counts = np.sum([np.bincount(one.ravel(), minlength=256) for one in self.labels], axis=0)
        return {name: int(counts[label]) for label, name in self.names.items()}

    def apply_to(self, volume: Volume) -> Volume:
        """Return a volume of the same grid with these labels."""
        return dataclasses.replace(volume, labels=self.labels, label_names=self.names)
