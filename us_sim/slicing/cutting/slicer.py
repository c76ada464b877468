"""Cutting images from a volume that deformed tissue carries: one interface, methods by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SLICERS
from us_sim.slicing.cutting.resampling import (
    get_label_voxels,
    run_rows_in_parallel,
    sample_labels,
    sample_nearest,
    sample_plane,
)
from us_sim.slicing.cutting.section import RestMesh
from us_sim.slicing.probe.plane import SlicePlane

if TYPE_CHECKING:
    from us_sim.slicing.cutting.resampling import LocatedPixels
    from us_sim.volume.volume import Volume


class Slicer(ABC):
    """Cuts images from a volume that is carried by a deformed tetrahedral mesh.

    A pixel in the deformed mesh (its surface included) shows the volume at its rest position. One
    outside shows the volume as it is, unless the mesh covers it at rest: tissue that was pushed
    away leaves black behind, not its ghost. Beyond the volume, and outside a plane's spans, all
    is black.

    Raises:
        MeshError: the mesh is not finite, or its tetrahedra name nodes that are not there.

    Examples:
        >>> from us_sim.geometry.pose import Pose
        >>> from us_sim.slicing.probe.probe import LinearProbe
        >>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
        >>> from us_sim.volume.volume import Volume
        >>> mesh = box_mesh([0.0, 0.04], [0.0, 0.04], [0.0, 0.04])
        >>> depths = np.tile(np.arange(40, dtype=np.uint8), (40, 40, 1))  # mm
        >>> volume = Volume(depths, np.diag([1e-3, 1e-3, 1e-3, 1.0]))
        >>> slicer = create_slicer("scan_conversion", volume, mesh.nodes, mesh.tetrahedra)
        >>> plane = LinearProbe(aperture=0.02, depth=0.02, columns=20, rows=20).make_plane(
        ...     Pose([0.02, 0.02, 0.0])
        ... )
        >>> slicer.cut_image(mesh.nodes * [1.0, 1.0, 0.5], plane)[:4, 10]  # pressed to a half
        array([1, 3, 5, 7], dtype=uint8)
    """

    skipped: int = 0  # inverted or flat tetrahedra on the latest image, which were left out

    def __init__(
        self, volume: Volume, rest_nodes: ArrayLike, tetrahedra: ArrayLike, *, threads: int = 1
    ) -> None:
        """Take ``rest_nodes`` (N, 3) m in the undeformed volume; ``tetrahedra`` (M, 4) index them.

        The image does not depend on the number of threads.
        """
        self._volume, self._threads = volume, threads
        self._mesh = RestMesh(rest_nodes, tetrahedra, volume.patient_to_index)
        self._prepare()

    def _prepare(self) -> None:  # noqa: B027
        """Prepare everything that all images of the mesh share."""

    @abstractmethod
    def cut_image(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        """Cut the B-mode image (rows, columns) with the mesh at ``nodes`` (N, 3) m.

        Grey values are trilinear in the undeformed volume.

        Raises:
            MeshError: another number of nodes than at rest, or nodes that are not finite.
        """

    @abstractmethod
    def locate_pixels(self, nodes: ArrayLike, plane: SlicePlane) -> LocatedPixels:
        """Find the tetrahedron and the rest place of each pixel.

        Right after an image of these same two objects the mesh is not cut again, so nodes must not
        be written to in between.
        """

    def locate_pixel_subset(
        self, nodes: ArrayLike, plane: SlicePlane, steps: tuple[int, int]
    ) -> LocatedPixels:
        """Locate every n-th row and column from 0 on, n by ``steps``."""
        return self.locate_pixels(nodes, plane).take_every(steps)

    def cut_labels(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.uint8]:
        """Cut the label image (rows, columns): the nearest voxel's label, 0 where there is nothing.

        Raises:
            VolumeError: the volume has no labels.
        """
        get_label_voxels(self._volume)  # refuses before the work
        return self.sample_located_labels(self._locate_anew(nodes, plane))

    def _locate_anew(self, nodes: ArrayLike, plane: SlicePlane) -> LocatedPixels:
        """Locate the pixels, though nodes may have been written to since an image of them."""
        return self.locate_pixels(np.asarray(nodes).view(), plane)

    def sample_located_labels(self, located: LocatedPixels) -> NDArray[np.uint8]:
        """Sample the label image (rows, columns) of pixels that `locate_pixels` has found.

        Raises:
            VolumeError: the volume has no labels.
        """
        voxels, shape = get_label_voxels(self._volume)
        elements, maps = located.elements, located.maps
        image = np.empty(elements.shape, dtype=np.uint8)
        run_rows_in_parallel(
            self._threads,
            len(elements),
            lambda a, b: sample_nearest(voxels, shape, maps, elements, a, b, image),
        )
        return image

    def compute_rest_coordinates(self, nodes: ArrayLike, plane: SlicePlane) -> NDArray[np.float64]:
        """Compute the rest place of each pixel's tissue: (rows, columns, 3) m, frame ``patient``.

        Outside the mesh that is the pixel itself; NaN where tissue moved away, and outside spans.
        """
        to_patient = self._volume.index_to_patient
        index = self._locate_anew(nodes, plane).compute_rest_index()
        return np.asarray(index @ to_patient[:3, :3].T + to_patient[:3, 3])


def create_slicer(
    name: str, volume: Volume, rest_nodes: ArrayLike, tetrahedra: ArrayLike, *, threads: int = 1
) -> Slicer:
    """Create the slicer of that name among `SLICERS`; further arguments as for `Slicer`.

    Raises:
        SettingsError: there is no method of that name; the sentence says which there are.
        MeshError: the mesh cannot be used.
    """
    made = SLICERS.load(name)
    slicer: Slicer = made(volume, rest_nodes, tetrahedra, threads=threads)
    return slicer


def warm_up(name: str, threads: int = 1) -> None:
    """Compile every kernel of a method, or load it from numba's cache, by cutting a tiny image.

    The kernels for a volume without tissue are included.
    """
    from us_sim.slicing.probe.probe import LinearProbe
    from us_sim.volume.volume import Volume

    voxels = np.zeros((2, 2, 2), dtype=np.uint8)
    volume = Volume(voxels, np.eye(4), voxels, {0: "nothing"})
    nodes = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]]) - 2e-4
    slicer = create_slicer(name, volume, nodes, np.array([[0, 1, 2, 3]]), threads=threads)
    plane = LinearProbe(aperture=0.01, depth=0.01, columns=4, rows=4).make_plane(Pose())
    slicer.cut_image(1.1 * nodes, plane)
    slicer.cut_labels(nodes, plane)
    slicer.locate_pixel_subset(nodes, plane, (2, 2))
    slicer.compute_rest_coordinates(nodes, plane)
    sample_plane(volume, plane, threads=threads)
    sample_labels(volume, plane, threads=threads)
