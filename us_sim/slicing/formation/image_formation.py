"""The picture as the console forms it from slices, each part only where a setting asks for it.

>>> import numpy as np
>>> from us_sim.slicing.formation.image_formation import ImageFormation
>>> from us_sim.slicing.formation.imaging import Imaging
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> slice_ = np.full((4, 4), 100, dtype=np.uint8)
>>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=4, rows=4)
>>> ImageFormation(probe, Imaging()).form([slice_]) is slice_
True
>>> ImageFormation(probe, Imaging(gain=6.0)).form([slice_])[0]
array([126, 126, 126, 126], dtype=uint8)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.slicing.formation.imaging import Imaging
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import Probe

if TYPE_CHECKING:
    from us_sim.slicing.formation.elevation import Elevation
    from us_sim.slicing.formation.gel_layer import GelLayer
    from us_sim.slicing.formation.grey_levels import GreyLevels
    from us_sim.slicing.formation.resolution import Resolution
    from us_sim.slicing.formation.reverberation import Reverberation


class ImageFormation:
    """The stages between slices and the picture, in the order in which echoes meet them.

    They are the beam's thickness, the layer of gel at the face, what sound meets on its way, the
    beam's width and the pulse's length; then air in front of the face; then gain, dynamic range and
    grey map. The result depends on settings and arguments only.

    Args:
        probe: its geometry.
        imaging: the settings; a stage whose settings are at their defaults is not even imported.
    """

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        self._probe = probe
        self._elevation: Elevation | None = None
        self._gel_layer: GelLayer | None = None
        self._resolution: Resolution | None = None
        self._reverberation: Reverberation | None = None
        self._grey_levels: GreyLevels | None = None
        if imaging.elevation_planes > 1:
            from us_sim.slicing.formation.elevation import Elevation

            self._elevation = Elevation(probe, imaging)
        if imaging.lateral_resolution > 0.0 or imaging.axial_resolution > 0.0:
            from us_sim.slicing.formation.resolution import Resolution

            self._resolution = Resolution(probe, imaging)
        if imaging.contact:
            from us_sim.slicing.formation.gel_layer import GelLayer
            from us_sim.slicing.formation.reverberation import Reverberation

            self._gel_layer = GelLayer(probe)
            self._reverberation = Reverberation(probe, imaging)
        if imaging.changes_grey_levels:
            from us_sim.slicing.formation.grey_levels import GreyLevels

            self._grey_levels = GreyLevels(probe, imaging)

    @property
    def needs_contact(self) -> bool:
        """Whether `form` asks how each line meets the skin."""
        return self._reverberation is not None

    def planes(self, pose: Pose, plane: SlicePlane | None = None) -> list[SlicePlane]:
        """The planes to cut with the probe at ``pose``, from the lowest y of the probe on.

        Args:
            plane: the probe's own at that pose, where it is there already.

        Raises:
            ProbeError: the pose is nowhere near.
        """
        plane = plane or self._probe.plane(pose)
        if self._resolution is not None and plane.spans is not None:
            # Beside a fan's edge there is tissue too, which its outer beams see.
            plane = dataclasses.replace(plane, spans=None)
        if self._elevation is None:
            return [plane]
        normal = pose.rotation[:, 1]
        return [
            dataclasses.replace(plane, origin=plane.origin + y * normal)
            for y in self._elevation.offsets
        ]

    def form(
        self,
        images: Sequence[NDArray[np.uint8]],
        coupling: NDArray[np.float32] | None = None,
        gap: NDArray[np.float64] | None = None,
        heard: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None,
    ) -> NDArray[np.uint8]:
        """The picture (rows, columns); the first image itself when nothing is to be done.

        Args:
            images: the slices on `planes`, (rows, columns) each.
            coupling: (lines,) from 0 in air to 1 in full contact; None is full contact.
            gap: (lines,) m, from the face to what carries the volume; None is none.
            heard: makes of echoes (rows, columns) what is left of them on their way; None is all.
        """
        image = images[0]
        if self._elevation is not None:
            image = self._elevation.average(images)
        if self._gel_layer is not None and coupling is not None and gap is not None:
            image = self._gel_layer.filled(image, gap, coupling)
        if heard is not None:
            image = heard(image)
        if self._resolution is not None:
            image = self._resolution.spread(image)
        if self._reverberation is not None and coupling is not None:
            image = self._reverberation.shown(image, coupling)
        if self._grey_levels is not None:
            image = self._grey_levels.shown(image)
        return image
