"""The error of the last frame's linear prediction, carried along with the probe to the next frame.

>>> import numpy as np
>>> from us_sim.tissue.contact.carried_correction import CarriedCorrection
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> planes = uniform_planes(0.0, 0.1, 5)
>>> mesh = box_mesh(planes, planes, planes)
>>> correction = CarriedCorrection(mesh)
>>> step = np.array([0.001, 0, 0, 0, 0, 0])
>>> down = np.array([0.0, 0.0, 1.0])
>>> missed = np.zeros((3, len(mesh.nodes)))
>>> missed[2] = 0.01 * mesh.nodes[:, 0]
>>> correction.learn(missed, step)
>>> bool(np.allclose(correction.guess(step, down)[2], 0.01 * (mesh.nodes[:, 0] - 0.001)))
True
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

__all__ = ["CarriedCorrection"]


class CarriedCorrection:
    """Guesses the nonlinear part of a frame's change from that of the frame before.

    Under a probe that slides on as before, the same correction is due again, displaced by the
    slide. Where the probe presses down, the tissue goes with it, and the correction stays with the
    tissue.

    Args:
        mesh: in frame ``patient``.
    """

    def __init__(self, mesh: TetrahedralMesh) -> None:
        self._tetrahedra = mesh.tetrahedra
        around = np.zeros(len(mesh.nodes))
        np.add.at(around, mesh.tetrahedra, mesh.volumes[:, None])
        self._gradients = shape_gradients(mesh).astype(np.float32)
        self._volumes = mesh.volumes.astype(np.float32)
        self._inverse_volume = (1.0 / around).astype(np.float32)
        self.forget()

    def forget(self) -> None:
        """Guess nothing until something was learned."""
        self._field: NDArray[np.float64] | None = None
        self._motion = np.zeros(6)

    def learn(self, field: NDArray[np.float64], motion: NDArray[np.float64]) -> None:
        """Take a correction (3, N) m and the probe's motion (6,) m that it belonged to."""
        self._field, self._motion = field, motion

    def guess(
        self, motion: NDArray[np.float64], normal: NDArray[np.float64]
    ) -> NDArray[np.float64] | None:
        """The correction (3, N) m for a motion, or None.

        Args:
            motion: (6,) m, translation, and turn times a lever.
            normal: (3,) direction in which the probe presses.
        """
        length = float(self._motion @ self._motion)
        if self._field is None or length == 0.0:
            return None
        likeness = min(max(float(motion @ self._motion) / length, 0.0), 1.0)
        if likeness == 0.0:
            return None
        slide = motion[:3] - (motion[:3] @ normal) * normal
        carried = self._field.copy()
        if slide.any():
            change = np.zeros(self._field.shape, np.float32)
            _slopes_along(
                slide.astype(np.float32),
                self._field.astype(np.float32),
                self._tetrahedra,
                self._gradients,
                self._volumes,
                change,
            )
            carried -= change * self._inverse_volume
        return likeness * carried


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _slopes_along(direction, field, tetrahedra, gradients, volumes, change):
    """change (3, N) += each tetrahedron's volume times the field's (3, N) slope, at its nodes."""
    for e in range(len(tetrahedra)):
        x = y = z = np.float32(0)
        for a in range(4):
            i = tetrahedra[e, a]
            g = gradients[e, a]
            s = direction[0] * g[0] + direction[1] * g[1] + direction[2] * g[2]
            x += s * field[0, i]
            y += s * field[1, i]
            z += s * field[2, i]
        v = volumes[e]
        for a in range(4):
            i = tetrahedra[e, a]
            change[0, i] += v * x
            change[1, i] += v * y
            change[2, i] += v * z
