"""One image's moment: where the probe and the tissue are, and whatever is asked of it.

Everything is made when it is first asked for, and once: the echoes, the labels and where each pixel
lies in the mesh come from one cut of the mesh where they can.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.b_mode import BMode
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.volume.volume import Volume
>>> voxels = np.full((20, 20, 20), 90, np.uint8)
>>> volume = Volume(voxels, np.diag([1e-3, 1e-3, 1e-3, 1.0]), voxels // 30, {3: "muscle"})
>>> probe = LinearProbe(aperture=0.01, depth=0.01, columns=4, rows=3)
>>> frame = BMode(volume, probe).frame(Pose([0.01, 0.01, 0.005]))
>>> frame.pixels[0], frame.labels[0]
(array([90, 90, 90, 90], dtype=uint8), array([3, 3, 3, 3], dtype=uint8))
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.resampling import (
    BLACK,
    Located,
    pixel_to_index,
    sample_labels,
    sample_plane,
)
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import Probe

if TYPE_CHECKING:
    from us_sim.slicing.cutting.slicer import Slicer
    from us_sim.volume.volume import Volume

Contact = tuple[NDArray[np.float32], NDArray[np.float64]]
Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


class Frame:
    """What one image shows, and what is known of its pixels.

    Args:
        pose: of the probe.
        nodes: (N, 3) m, where the mesh that carries the volume is; None for the volume as it is.
            They are kept, not copied: they must not be written to again.
        probe: whose image it is.
        volume: in frame ``patient``.
        slicer: of the mesh; needed where there are nodes.
        form: makes the picture of the frame.
        meet: how each line meets the skin, see `contact`; None where all are taken to meet it.
        skin: (V, 3) m, where the skin's vertices are; None where it is not known.
        mesh: rest nodes (N, 3) m and tetrahedra (M, 4) that carry the volume; None without nodes.
        number: of the poses so far; frames with successive numbers follow one another.
        time: s since 1970, of the pose; what moves by itself, as blood does, moves with it.
        threads: number of threads.
    """

    def __init__(
        self,
        pose: Pose,
        nodes: NDArray[np.float64] | None,
        probe: Probe,
        volume: Volume,
        slicer: Slicer | None,
        form: Callable[[Frame], NDArray[np.uint8]],
        *,
        meet: Callable[[Frame], Contact] | None = None,
        skin: NDArray[np.float64] | None = None,
        mesh: Mesh | None = None,
        number: int = 0,
        time: float = 0.0,
        threads: int = 1,
    ) -> None:
        self.pose = pose
        self.nodes = nodes
        self.probe = probe
        self.volume = volume
        self._slicer = slicer if nodes is not None else None
        self._form = form
        self._meet = meet
        self.skin = skin
        self.mesh = mesh
        self.number = number
        self.time = time
        self.threads = threads
        self._cut = 0  # of the slicer, on this frame's plane

    @cached_property
    def plane(self) -> SlicePlane:
        """Where the pixels are.

        Raises:
            ProbeError: the pose is nowhere near.
        """
        return self.probe.plane(self.pose)

    @cached_property
    def pixels(self) -> NDArray[np.uint8]:
        """The B-mode picture (rows, columns).

        Raises:
            MeshError: the nodes are not as many as at rest, or not finite.
            ProbeError: the pose is nowhere near.
            VolumeError: the volume has too many voxels.
        """
        return self._form(self)

    @cached_property
    def contact(self) -> Contact | None:
        """Coupling (lines,) from 0 in air to 1, and gap (lines,) m; None where none is modelled.

        Raises:
            MeshError: as for `pixels`.
        """
        return None if self._meet is None else self._meet(self)

    @cached_property
    def labels(self) -> NDArray[np.uint8]:
        """The volume's label at each pixel (rows, columns), 0 where there is nothing.

        Raises:
            VolumeError: the volume has no labels.
            MeshError, ProbeError: as for `pixels`.
        """
        if self._slicer is None:
            return sample_labels(self.volume, self.plane, threads=self.threads)
        return self._slicer.labels_at(self.located)

    @cached_property
    def located(self) -> Located:
        """Where each pixel lies in the mesh.

        Raises:
            MeshError: there is no mesh, or as for `pixels`.
        """
        if self._slicer is None:
            raise MeshError("no tissue carries the volume, so no pixel lies in its mesh")
        assert self.nodes is not None
        return self._slicer.locate(self.nodes, self.plane, self._cut)

    @property
    def placed(self) -> Located:
        """Where each pixel lies in the mesh, or in the volume as it is.

        Raises:
            MeshError: as for `pixels`.
        """
        return self.located if self._slicer is not None else self._rigid

    @cached_property
    def _rigid(self) -> Located:
        plane = self.plane
        elements = np.zeros((plane.rows, plane.columns), dtype=np.int32)
        if plane.spans is not None:
            elements[~plane.is_shown()] = BLACK
        return Located(elements, pixel_to_index(self.volume, plane)[None], np.empty(0, np.intp))

    def locate_some(self, steps: tuple[int, int]) -> Located:
        """Where every so many-th pixel lies in the mesh, see `Slicer.locate_some`.

        Raises:
            MeshError: as for `located`.
        """
        if self._slicer is None or "located" in self.__dict__:
            return self.located.some(steps)
        assert self.nodes is not None
        return self._slicer.locate_some(self.nodes, self.plane, steps, self._cut)

    def slice(self, plane: SlicePlane) -> NDArray[np.uint8]:
        """The volume's grey values (rows, columns) on a plane, as the tissue carries them now.

        Raises:
            MeshError, VolumeError: as for `pixels`.
        """
        if self._slicer is None:
            return sample_plane(self.volume, plane, threads=self.threads)
        assert self.nodes is not None
        image = self._slicer.image(self.nodes, plane)
        if plane is self.plane:
            self._cut = self._slicer.cuts
        return image
