"""The scanner as a whole: it shows a volume through a probe, with deformed tissue or without."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.geometry.mesh_faces import find_boundary_triangles
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.slicer import Slicer, create_slicer, warm_up
from us_sim.slicing.formation.image_formation import ImageFormation
from us_sim.slicing.frame import Frame, Mesh
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import Imaging

if TYPE_CHECKING:
    from us_sim.slicing.acoustics.beam_acoustics import BeamAcoustics
    from us_sim.slicing.acoustics.settings import Acoustics
    from us_sim.slicing.formation.coupling import ContactSurface
    from us_sim.volume.volume import Volume


class BMode:
    """Makes frames: a probe's images of a volume, cut and formed as the settings ask.

    Args:
        volume: in frame ``patient``.
        probe: its geometry; `apply_settings` exchanges it.
        imaging: the console's settings.
        acoustics: what sound meets along the beams; None for no more than the volume holds.
        method: how slices through deformed tissue are cut, see `us_sim.settings.registry.SLICERS`.

    Raises:
        ProbeError: the acoustics do not go with volume and probe, see `BeamAcoustics`.

    Examples:
        >>> from us_sim.scene.building import build_probe, load_volume
        >>> from us_sim.geometry.pose import Pose
        >>> from us_sim.scene.reading import parse_scene
        >>> volume = {"phantom": "upper_arm", "voxel_size": "1 mm"}
        >>> probe = {"aperture": "4 cm", "depth": "3 cm", "image": [40, 30]}
        >>> scene = parse_scene({"name": "bare", "volume": volume, "probe": probe})
        >>> scanner = BMode(load_volume(scene), build_probe(scene))
        >>> scanner.render_image(Pose([0, 0, 0.002])).shape
        (30, 40)
    """

    def __init__(
        self,
        volume: Volume,
        probe: Probe,
        imaging: Imaging | None = None,
        acoustics: Acoustics | None = None,
        *,
        method: str = "scan_conversion",
        threads: int = 1,
    ) -> None:
        self._volume = volume
        self._method = method
        self._threads = threads
        self._mesh: Mesh | None = None
        self._slicer: Slicer | None = None
        self._surface: ContactSurface | None = None
        self._skin: ContactSurface | None = None
        self._acoustics: BeamAcoustics | None = None
        self._prepared: tuple[Probe, Acoustics, BeamAcoustics] | None = None
        self.apply_settings(probe, imaging or Imaging(), acoustics)

    @property
    def skipped(self) -> int:
        """Inverted or flat tetrahedra that the latest slice left out."""
        return self._slicer.skipped if self._slicer else 0

    def apply_settings(
        self, probe: Probe, imaging: Imaging, acoustics: Acoustics | None = None
    ) -> None:
        """Apply another probe, or other settings, from the next image on."""
        self._acoustics = self._acoustics_of(probe, acoustics)
        if self._acoustics is not None:
            imaging = self._acoustics.resolve_imaging(imaging)
            if self._mesh is not None:
                self._acoustics.attach_mesh(*self._mesh)
        self.probe = probe
        self._formation = ImageFormation(probe, imaging)

    def prepare_settings(
        self, probe: Probe, imaging: Imaging, acoustics: Acoustics | None = None
    ) -> None:
        """Load everything for images with these settings, so that the first is not late."""
        warm_up(self._method, self._threads)
        live = self._acoustics_of(probe, acoustics)
        if live is not None and acoustics is not None:
            live.warm_up()
            self._prepared = probe, acoustics, live
            imaging = live.resolve_imaging(imaging)
        formation = ImageFormation(probe, imaging)
        blank = np.zeros((probe.rows, probe.columns), dtype=np.uint8)
        blanks = [blank for _ in formation.make_planes(Pose())]
        if not formation.needs_contact:
            formation.form_picture(blanks)
            return
        surface = self._contact_surface(deformed=False)
        formation.form_picture(blanks, *surface.measure_contact(surface.rest_nodes, probe, Pose()))

    def attach_mesh(self, rest_nodes: ArrayLike, tetrahedra: ArrayLike) -> None:
        """Let this mesh carry the volume: (N, 3) m at rest, and (M, 4) indices into them.

        Raises:
            MeshError: the mesh cannot be used, or there is none in it; then the one before still
                carries the volume.
        """
        if not (np.size(rest_nodes) and np.size(tetrahedra)):
            raise MeshError("the mesh has no tetrahedra, so it cannot carry a volume")
        self._slicer = create_slicer(
            self._method, self._volume, rest_nodes, tetrahedra, threads=self._threads
        )
        self._mesh = np.asarray(rest_nodes, dtype=np.float64), np.asarray(tetrahedra, np.int32)
        self._surface = None
        if self._acoustics is not None:
            self._acoustics.attach_mesh(*self._mesh)

    def attach_skin(self, vertices: ArrayLike, triangles: ArrayLike) -> None:
        """Let the face touch this skin, in frames that know where it lies.

        Args:
            vertices: (V, 3) m, at rest.
            triangles: (T, 3) indices into them, normals out of the body.

        Raises:
            MeshError: the arrays do not have those shapes, or a triangle names a vertex that is not
                there.
        """
        from us_sim.slicing.formation.coupling import ContactSurface

        self._skin = ContactSurface(vertices, triangles, is_outward=True)

    def make_frame(
        self,
        pose: Pose,
        nodes: NDArray[np.float64] | None = None,
        *,
        skin: NDArray[np.float64] | None = None,
        number: int = 0,
        time: float = 0.0,
    ) -> Frame:
        """Make the frame with the probe at ``pose``, whose images are made when first asked for.

        Args:
            pose: of the probe.
            nodes: (N, 3) m, of the carrying mesh; None for the volume as it is. Kept, not copied.
            skin: (V, 3) m, where the vertices given to `attach_skin` are.
            number: of the poses so far.
            time: s since 1970, of the pose.
        """
        touches = self._formation.needs_contact
        return Frame(
            pose,
            nodes,
            self.probe,
            self._volume,
            slicer=self._slicer,
            formation=self._formation,
            acoustics=self._acoustics,
            surface=self._contact_surface(nodes is not None) if touches else None,
            skin_surface=self._skin,
            skin=skin,
            mesh=self._mesh if nodes is not None else None,
            number=number,
            time=time,
            threads=self._threads,
        )

    def render_image(
        self, pose: Pose, nodes: NDArray[np.float64] | None = None
    ) -> NDArray[np.uint8]:
        """Render the B-mode image (rows, columns) with the probe at ``pose``: `Frame.pixels`."""
        return self.make_frame(pose, nodes).pixels

    def render_labels(
        self, pose: Pose, nodes: NDArray[np.float64] | None = None
    ) -> NDArray[np.uint8]:
        """Render the volume's label at each pixel (rows, columns), 0 where there is nothing."""
        return self.make_frame(pose, nodes).labels

    def measure_excess_depth(self, pose: Pose, *, pressed: bool = True) -> float:
        """Return `measure_excess_depth` beyond the mesh at rest, or the volume without one."""
        extent = self._volume.extent
        if self._mesh is not None:
            extent = np.stack([self._mesh[0].min(axis=0), self._mesh[0].max(axis=0)])
        return measure_excess_depth(self.probe, pose, extent, pressed=pressed or self._mesh is None)

    def _acoustics_of(self, probe: Probe, acoustics: Acoustics | None) -> BeamAcoustics | None:
        if acoustics is None or not acoustics.is_live:
            return None
        prepared, self._prepared = self._prepared, None
        if prepared is not None and prepared[:2] == (probe, acoustics):
            return prepared[2]
        from us_sim.slicing.acoustics.beam_acoustics import BeamAcoustics

        return BeamAcoustics(self._volume, probe, acoustics)

    def _contact_surface(self, deformed: bool) -> ContactSurface:
        if self._surface is None:
            from us_sim.slicing.formation.coupling import ContactSurface

            if not deformed or self._mesh is None:
                return ContactSurface(*_outer_box(self._volume))
            rest_nodes, tetrahedra = self._mesh
            self._surface = ContactSurface(rest_nodes, find_boundary_triangles(tetrahedra))
        return self._surface


def _outer_box(volume: Volume) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the outer faces of a volume's voxels: 8 corners (8, 3) m and 12 triangles."""
    # Corners by the bits of x, y and z in their number; faces outward.
    faces = (0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)
    bits = np.array([[(corner >> axis) & 1 for axis in range(3)] for corner in range(8)])
    index = bits * np.array(volume.shape) - 0.5
    to_patient = volume.index_to_patient
    triangles = [(a, *pair) for a, b, c, d in faces for pair in ((b, c), (c, d))]
    return index @ to_patient[:3, :3].T + to_patient[:3, 3], np.array(triangles, dtype=np.int32)


def measure_excess_depth(
    probe: Probe, pose: Pose, extent: NDArray[np.float64], *, pressed: bool = True
) -> float:
    """Return the m of the middle beam behind a box; 0 where it ends within or never enters it.

    Args:
        probe: whose beam it is.
        pose: of the probe.
        extent: (2, 3) m, lower and upper corner of the box in the pose's parent frame.
        pressed: False is as if a probe in the box stood where its middle beam enters that.
    """
    direction = pose.rotation[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = (extent - pose.position) / direction
    entered, left = np.nanmax(distances.min(axis=0)), np.nanmin(distances.max(axis=0))
    if not (entered < left and left > 0.0 and entered < probe.depth):
        return 0.0
    return max(0.0, float(probe.depth - left + (0.0 if pressed else min(entered, 0.0))))
