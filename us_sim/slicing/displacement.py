"""How far the tissue that each pixel shows has moved since it was at rest.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.b_mode import BMode
>>> from us_sim.slicing.displacement import displacement
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> from us_sim.volume.volume import Volume
>>> volume = Volume(np.zeros((41, 41, 41), np.uint8), np.diag([1e-3, 1e-3, 1e-3, 1.0]))
>>> mesh = box_mesh([0.0, 0.04], [0.0, 0.04], [0.0, 0.04])
>>> scanner = BMode(volume, LinearProbe(aperture=0.01, depth=0.02, columns=2, rows=2))
>>> scanner.carry(mesh.nodes, mesh.tetrahedra)
>>> pressed = mesh.nodes * [1, 1, 0.9] + [0, 0, 0.004]  # by 4 mm, on a floor at 40 mm
>>> moved = displacement(scanner.frame(Pose([0.02, 0.02, 0.01]), pressed))
>>> np.round(1e3 * moved[:, 0, 1], 3)  # mm, down the first column
array([2.778, 1.667], dtype=float32)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.cutting.located import evaluate
from us_sim.slicing.frame import Frame


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
