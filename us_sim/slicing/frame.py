"""One image: where the probe and the tissue are, and everything known of its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.resampling import (
    BLACK,
    LocatedPixels,
    compute_pixel_to_index,
    sample_labels,
    sample_plane,
)
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import Probe

if TYPE_CHECKING:
    from us_sim.slicing.cutting.slicer import Slicer
    from us_sim.slicing.formation.coupling import ContactSurface
    from us_sim.slicing.formation.image_formation import ImageFormation
    from us_sim.volume.volume import Volume

Contact = tuple[NDArray[np.float32], NDArray[np.float64]]
Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


class Sound(Protocol):
    """The way of beams through tissue, such as `BeamAcoustics`."""

    def apply_acoustics(self, image: NDArray[np.uint8], frame: Frame) -> NDArray[np.uint8]:
        """Return the image as its beams bring it."""


@dataclass(eq=False)
class Frame:
    """One image's probe and tissue, and its pixels: each made when first asked for, once.

    Echoes, labels and the place of each pixel in the mesh come from one cut where they can.

    Raises:
        MeshError: the nodes are not as many as at rest, or not finite.
        ProbeError: the pose is nowhere near.
        VolumeError: the volume has too many voxels.
    """

    pose: Pose  # of the probe
    nodes: NDArray[np.float64] | None  # (N, 3) m, of the carrying mesh; not to be written to again
    probe: Probe
    volume: Volume  # in frame ``patient``
    slicer: Slicer | None = None  # of the mesh; needed where there are nodes
    formation: ImageFormation | None = None  # None shows the slice as it is
    acoustics: Sound | None = None  # None for no more than the volume holds
    surface: ContactSurface | None = None  # of tissue or volume, that the face can touch
    skin_surface: ContactSurface | None = None
    skin: NDArray[np.float64] | None = None  # (V, 3) m, the skin's vertices; None if not known
    mesh: Mesh | None = None  # rest nodes (N, 3) m and tetrahedra (M, 4); None without nodes
    number: int = 0  # of the poses so far; frames with successive numbers follow one another
    time: float = 0.0  # s since 1970, of the pose; blood moves with it
    threads: int = 1

    @cached_property
    def plane(self) -> SlicePlane:
        """The grid of the pixels."""
        return self.probe.make_plane(self.pose)

    @cached_property
    def pixels(self) -> NDArray[np.uint8]:
        """The B-mode picture (rows, columns)."""
        if self.formation is None:
            return self.sample_plane(self.plane)
        slices = [
            self.sample_plane(plane) for plane in self.formation.make_planes(self.pose, self.plane)
        ]
        heard = (
            None if self.acoustics is None else partial(self.acoustics.apply_acoustics, frame=self)
        )
        coupling, gap = self.contact or (None, None)
        return self.formation.form_picture(slices, coupling, gap, heard)

    @cached_property
    def contact(self) -> Contact | None:
        """Coupling (lines,) from 0 in air to 1, and gap (lines,) m; None where none is modelled.

        Coupling is that to the skin, where it is known, else to the mesh's own surface.
        """
        if self.surface is None:
            return None
        where = self.surface.rest_nodes if self.nodes is None else self.nodes
        coupling, gap = self.surface.measure_contact(where, self.probe, self.pose)
        if self.skin_surface is not None and self.skin is not None:
            coupling, _ = self.skin_surface.measure_contact(self.skin, self.probe, self.pose)
        return coupling, gap

    @cached_property
    def labels(self) -> NDArray[np.uint8]:
        """The volume's label at each pixel (rows, columns), 0 where there is nothing.

        Raises:
            VolumeError: the volume has no labels.
        """
        if self.nodes is None or self.slicer is None:
            return sample_labels(self.volume, self.plane, threads=self.threads)
        return self.slicer.sample_located_labels(self.located)

    @cached_property
    def located(self) -> LocatedPixels:
        """The tetrahedron and the rest place of each pixel.

        Raises:
            MeshError: there is no mesh.
        """
        if self.nodes is None or self.slicer is None:
            raise MeshError("no tissue carries the volume, so no pixel lies in its mesh")
        return self.slicer.locate_pixels(self.nodes, self.plane)

    @property
    def placed(self) -> LocatedPixels:
        """The place of each pixel in the mesh, or in the volume as it is."""
        return self._rigid if self.nodes is None or self.slicer is None else self.located

    @cached_property
    def _rigid(self) -> LocatedPixels:
        plane = self.plane
        elements = np.zeros((plane.rows, plane.columns), dtype=np.int32)
        elements[~plane.make_shown_mask()] = BLACK
        return LocatedPixels(
            elements, compute_pixel_to_index(self.volume, plane)[None], np.empty(0, np.intp)
        )

    def locate_pixel_subset(self, steps: tuple[int, int]) -> LocatedPixels:
        """Locate every n-th row and column, see `Slicer.locate_pixel_subset`."""
        if self.nodes is None or self.slicer is None or "located" in self.__dict__:
            return self.located.take_every(steps)
        return self.slicer.locate_pixel_subset(self.nodes, self.plane, steps)

    def sample_plane(self, plane: SlicePlane) -> NDArray[np.uint8]:
        """Sample the volume's grey values (rows, columns) on a plane, as tissue carries them."""
        if self.nodes is None or self.slicer is None:
            return sample_plane(self.volume, plane, threads=self.threads)
        return self.slicer.cut_image(self.nodes, plane)
