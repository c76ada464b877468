"""The acoustic coupling of the transducer's face to the skin, line by line.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.formation.coupling import ContactSurface
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> block = box_mesh([-0.01, 0.05], [-0.05, 0.05], [0.0, 0.05])  # skin from x = -10 mm on
>>> probe = LinearProbe(aperture=0.04, depth=0.04, lines=8)
>>> surface = ContactSurface(block.nodes, block.boundary)
>>> surface.contact(block.nodes, probe, Pose([0.0, 0.0, 0.002]))[0]  # pressed 2 mm
array([0., 0., 1., 1., 1., 1., 1., 1.], dtype=float32)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.slicing.probe.probe import Probe

GEL_FILM = (0.15e-3, 0.3e-3)
"""m: gel fills gaps between face and skin up to the first; from the second on there is air."""

GEL_BEAD = 0.2
"""Gap that gel fills in addition to `GEL_FILM`, over the depth of the face below the skin at rest.

Gel that is squeezed out gathers in the wedge where skin leaves a pressed face. The triangles of a
coarse mesh stand off a face that their nodes touch by as much.
"""

LIGHT_CONTACT = 0.2
"""Coupling where the face just touches: 14 dB less than in full contact, there and back."""

FULL_PRESS = 1e-3
"""m: depth of the face below the skin at rest at which hairs and creases are closed."""


class ContactSurface:
    """The outer surface of the body that the face can touch.

    Args:
        rest_nodes: (N, 3) m, frame ``patient``.
        triangles: (T, 3) indices into them; closed surfaces, all normals outward or all inward.
        is_outward: of an open surface, such as the skin over a part of the body: all normals are
            outward.

    Raises:
        MeshError: the arrays do not have those shapes, or a triangle names a node that is not
            there.
    """

    def __init__(
        self, rest_nodes: ArrayLike, triangles: ArrayLike, *, is_outward: bool = False
    ) -> None:
        nodes = np.array(rest_nodes, dtype=np.float64)
        corners = np.array(triangles, dtype=np.int32)
        if nodes.ndim != 2 or nodes.shape[1] != 3 or corners.ndim != 2 or corners.shape[1] != 3:
            raise MeshError(
                f"a contact surface needs nodes (N, 3) and triangles (T, 3), not {nodes.shape} "
                f"and {corners.shape}"
            )
        if corners.size and not 0 <= corners.min() <= corners.max() < len(nodes):
            raise MeshError(
                f"a contact surface of {len(nodes)} nodes has triangles that name others, from "
                f"{corners.min()} to {corners.max()}"
            )
        a, b, c = (nodes[corners[:, i]] for i in range(3))
        # Six times the volume.
        if not is_outward and np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0:
            corners = corners[:, ::-1].copy()
        self.rest_nodes = nodes
        self._triangles = corners

    def contact(
        self, nodes: ArrayLike, probe: Probe, pose: Pose
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """How each line meets the surface.

        Args:
            nodes: (N, 3) m, where the surface's nodes are now.

        Returns:
            (lines,) the fraction of an echo's amplitude transmitted: 0 in air, 1 in full contact;
            and (lines,) m, the gap as `gaps` says.

        Raises:
            MeshError: another number of nodes than at rest.
        """
        gap, press = self.gaps(nodes, probe, pose)
        near, far = GEL_FILM
        bead = GEL_BEAD * np.maximum(press, 0.0)
        wet = 1.0 - _smooth((gap - bead - near) / (far - near))
        firm = LIGHT_CONTACT + (1.0 - LIGHT_CONTACT) * _smooth(press / FULL_PRESS)
        return np.asarray(wet * firm, dtype=np.float32), gap

    def gaps(
        self, nodes: ArrayLike, probe: Probe, pose: Pose
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gap between face and surface along each line, and how far the face is pressed in there.

        Args:
            nodes: (N, 3) m, where the surface's nodes are now.

        Returns:
            (lines,) m, not positive where the face lies in the surface or within it, infinite
            where a line meets no surface; and (lines,) m, how far beyond the surface at rest the
            face is, along the line.

        Raises:
            MeshError: another number of nodes than at rest.
        """
        now = np.ascontiguousarray(nodes, dtype=np.float64)
        if now.shape != self.rest_nodes.shape:
            raise MeshError(
                f"the contact surface has {len(self.rest_nodes)} nodes at rest, but "
                f"{now.shape} coordinates came"
            )
        gap, press = np.empty(probe.lines), np.empty(probe.lines)
        _meet(
            now,
            self.rest_nodes,
            self._triangles,
            np.ascontiguousarray(pose.rotation),
            np.array(pose.position),
            probe.beam_starts,
            probe.beam_directions,
            gap,
            press,
        )
        return gap, press


def _smooth(ramp: NDArray[np.float64]) -> NDArray[np.float64]:
    """The ramp clipped to 0 and 1 without a kink at either (the smoothstep polynomial)."""
    ramp = np.clip(ramp, 0.0, 1.0)
    return ramp * ramp * (3.0 - 2.0 * ramp)


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(nodes, rest, triangles, rotation, position, starts, directions, gap, press):
    """Where each beam enters the surface: last before the face if that is inside, else first after.

    Folds of a surface that was pushed hard overlap. So the face is inside if the beam entered the
    surface more often than it left it, whatever it did last.

    Args:
        nodes, rest: (N, 3); triangles (T, 3), normals outward.
        rotation: (3, 3) from frame ``probe``; position (3,).
        starts, directions: (lines, 2).
        gap, press: (lines,), set.
    """
    lines = len(starts)
    entered = np.full(lines, -np.inf)
    depth = np.zeros(lines, dtype=np.int64)  # of the face: times entered less times left before it
    moved = np.zeros(lines)
    gap[:] = np.inf
    press[:] = 0.0
    point = np.empty((3, 6))  # of a triangle's corners: x, y, z of now in frame probe, and moved
    ends = np.empty((2, 4))  # of a cut: x, z, and the displacement along them
    for t in range(len(triangles)):
        above = 0
        for c in range(3):
            n = triangles[t, c]
            dx = nodes[n, 0] - position[0]
            dy = nodes[n, 1] - position[1]
            dz = nodes[n, 2] - position[2]
            y = rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz
            point[c, 0] = dx
            point[c, 1] = y
            point[c, 2] = dy
            point[c, 3] = dz
            above += y >= 0.0
        if above == 0 or above == 3:
            continue
        for c in range(3):
            n = triangles[t, c]
            dx, dy, dz = point[c, 0], point[c, 2], point[c, 3]
            point[c, 0] = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
            point[c, 2] = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
            dx = nodes[n, 0] - rest[n, 0]
            dy = nodes[n, 1] - rest[n, 1]
            dz = nodes[n, 2] - rest[n, 2]
            point[c, 3] = rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz
            point[c, 4] = rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz
        found = 0
        for c in range(3):
            d = (c + 1) % 3
            ya, yb = point[c, 1], point[d, 1]
            if (ya >= 0.0) != (yb >= 0.0):
                fraction = ya / (ya - yb)
                for q, axis in enumerate((0, 2, 3, 4)):
                    ends[found, q] = point[c, axis] + fraction * (point[d, axis] - point[c, axis])
                found += 1
        # The normal's x and z, of any length.
        ux, uy, uz = (
            point[1, 0] - point[0, 0],
            point[1, 1] - point[0, 1],
            point[1, 2] - point[0, 2],
        )
        vx, vy, vz = (
            point[2, 0] - point[0, 0],
            point[2, 1] - point[0, 1],
            point[2, 2] - point[0, 2],
        )
        normal_x = uy * vz - uz * vy
        normal_z = ux * vy - uy * vx
        for line in range(lines):
            x0, z0 = starts[line, 0], starts[line, 1]
            x, z = directions[line, 0], directions[line, 1]
            a = (ends[0, 0] - x0) * z - (ends[0, 1] - z0) * x
            b = (ends[1, 0] - x0) * z - (ends[1, 1] - z0) * x
            if (a >= 0.0) == (b >= 0.0):
                continue
            fraction = a / (a - b)
            distance = (ends[0, 0] + fraction * (ends[1, 0] - ends[0, 0]) - x0) * x + (
                ends[0, 1] + fraction * (ends[1, 1] - ends[0, 1]) - z0
            ) * z
            along = (ends[0, 2] + fraction * (ends[1, 2] - ends[0, 2])) * x + (
                ends[0, 3] + fraction * (ends[1, 3] - ends[0, 3])
            ) * z
            inward = normal_x * x + normal_z * z < 0.0
            if distance <= 0.0:
                depth[line] += 1 if inward else -1
                if inward and distance > entered[line]:
                    entered[line] = distance
                    moved[line] = along
            elif inward and distance < gap[line]:
                gap[line] = distance
                press[line] = along - distance
    for line in range(lines):
        if depth[line] > 0:
            gap[line] = entered[line]
            press[line] = moved[line] - entered[line]
