"""Estimated distance of a deformed tissue's nodes from the continuum, without any fitted constant.

The estimate is the root of the sum of the squares of two parts.

**Contact.** Tissue that a probe touches lies on it without friction. But flat triangles and springs
leave nodes beside it, pushed in other directions than its normals. So contact forces are replaced
by forces along the normals at the nodes, which put these exactly onto the probe, and the part is
how far linear tissue moves by that.

**Interpolation.** Linear tetrahedra leave out how a displacement is bent. Gradients recovered at
the nodes, as the mean of the tetrahedra around each (O. C. Zienkiewicz and J. Z. Zhu, A simple
error estimator and adaptive procedure, Int. J. Numer. Methods Eng. 24, 1987), tell its second
derivatives along the edges, and so the quadratic functions that are missing; the part is their L2
norm. Where materials meet, gradients jump, and that counts as error too.

**Force.** Nodes may be nearly where they belong while a force is far off: linear tetrahedra are too
stiff against bending, and a beam of few cells across hardly shows it in its shape. The mesh is too
stiff by the energy of the strains that it lacks over that of those it has; so much the force of a
press is too great, and the deflection by a load too small. These strains are the difference to
the mean around the nodes, weighted by shear stiffness; changes of volume are left out, as the
tetrahedra of nearly incompressible tissue have some that cancel.

An error of the model, such as linear strain in a deep press, is no part of it.

>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> side = np.linspace(0.0, 1.0, 9)
>>> mesh = box_mesh(side, side, side)
>>> estimate_interpolation_error(mesh, mesh.nodes @ np.ones((3, 3)))[0] < 1e-12  # linear: none
True
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.tissue.contact.complementarity import predict_forces
from us_sim.tissue.contact.probe_gap import FlaredProbe
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.linear_algebra.compliance import SurfaceCompliance
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import TissueModel

_LOOP: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


def estimate_relative_error(
    model: TissueModel,
    compliance: SurfaceCompliance,
    pose: Pose | None,
    displacement: NDArray[np.float64],
    forces: NDArray[np.float64],
    reach: float,
) -> float:
    """Estimate the relative L2 error of a displacement that is not zero.

    Args:
        model: of the tissue and the probe.
        compliance: of the surface that the probe can touch.
        pose: of the probe, None where there is none.
        displacement: (N, 3) m.
        forces: (N, 3) N, of contact.
        reach: m, nodes farther from the probe stay untouched.
    """
    missing, moved = estimate_interpolation_error(model.mesh, displacement)
    apart = 0.0
    if pose is not None:
        closing = estimate_contact_error(model, compliance, pose, displacement, forces, reach)
        apart = float(np.linalg.norm(closing) / np.linalg.norm(displacement))
    return math.hypot(missing / moved, apart)


def estimate_contact_error(
    model: TissueModel,
    compliance: SurfaceCompliance,
    pose: Pose,
    displacement: NDArray[np.float64],
    forces: NDArray[np.float64],
    reach: float,
) -> NDArray[np.float64]:
    """Return (N, 3) m, how linear tissue moves if its nodes alone are put onto the probe.

    The arguments are those of `estimate_relative_error`.
    """
    nodes = compliance.nodes
    places = model.mesh.nodes[nodes] + displacement[nodes]
    gap, normal = FlaredProbe(model.collider, model.contact_spacing).measure_distances(pose, places)
    held = np.ascontiguousarray(forces[nodes])
    change = predict_forces(compliance.matrix, gap, normal, held, np.zeros(len(nodes)), reach)
    return compliance.compute_displacement(change)


def estimate_force_error(
    mesh: TetrahedralMesh, materials: TissueMaterials, displacement: NDArray[np.float64]
) -> float:
    """Estimate how much, relative, a mesh is too stiff for a displacement (N, 3) m, not zero.

    >>> from us_sim.tissue.model import TissueModel
    >>> block = TissueModel.make_block((1.0, 1.0, 1.0), (5, 5, 5))
    >>> x, _, z = block.mesh.nodes.T - [[0.0], [0.0], [0.5]]
    >>> bent = 1e-6 * np.stack([-x * z, 0 * x, 0 * x], axis=1)
    >>> error = estimate_force_error(block.mesh, block.materials, bent)
    >>> 0.02 < error < 0.2  # four cells across: 1 / 15
    True
    """
    slope = np.einsum("eai,eaj->eij", displacement[mesh.tetrahedra], shape_gradients(mesh))
    slope += np.eye(3)
    strain = np.einsum("eki,ekj->eij", slope, slope) / 2  # Green's, and half the unit matrix
    strain -= np.einsum("ekk->e", strain)[:, None, None] * np.eye(3) / 3
    strain = strain.reshape(-1, 9)
    shear = mesh.volumes * materials.young_modulus / (2 * (1 + materials.poisson_ratio))
    around, count = mesh.tetrahedra.ravel(), len(mesh.nodes)
    weighted = np.repeat(shear[:, None] * strain, 4, axis=0)
    total = np.stack([np.bincount(around, column, count) for column in weighted.T], axis=1)
    mean = total / np.bincount(around, np.repeat(shear, 4), count)[:, None]
    lacking = mean[mesh.tetrahedra] - strain[:, None]
    squares = (lacking**2).sum(axis=(1, 2)) + (lacking.sum(axis=1) ** 2).sum(axis=1)
    return float(shear @ squares / 20 / (shear @ (strain**2).sum(axis=1)))


def estimate_interpolation_error(
    mesh: TetrahedralMesh, displacement: NDArray[np.float64]
) -> tuple[float, float]:
    """Estimate the quadratic functions that a displacement (N, 3) m misses.

    Returns:
        L2 norms over the volume, in m times the root of m3, of these and of the displacement.
    """
    gradients, volumes = np.zeros((len(mesh.nodes), 3, 3)), np.zeros(len(mesh.nodes))
    _add_gradients(mesh.nodes, mesh.tetrahedra, displacement, gradients, volumes)
    gradients /= np.maximum(volumes, np.finfo(float).tiny)[:, None, None]
    missing = _missing(mesh.nodes, mesh.tetrahedra, gradients)
    return math.sqrt(missing), math.sqrt(float(volumes @ (displacement**2).sum(axis=1)))


@njit(**_LOOP)
def _add_gradients(nodes, tetrahedra, displacement, gradients, volumes):
    """Add to gradients (N, 3, 3) and volumes (N,) at the nodes of each tetrahedron.

    Each of its nodes gets a quarter of its gradient times its volume, and of its volume.
    """
    e, area = np.empty((3, 3)), np.empty((3, 3))
    for t in range(len(tetrahedra)):
        four = tetrahedra[t]
        for k in range(3):
            for d in range(3):
                e[k, d] = nodes[four[k + 1], d] - nodes[four[0], d]
        for k in range(3):
            a, b = e[(k + 1) % 3], e[(k + 2) % 3]
            for d in range(3):
                i, j = (d + 1) % 3, (d + 2) % 3
                area[k, d] = (a[i] * b[j] - a[j] * b[i]) / 24
        volume = e[0, 0] * area[0, 0] + e[0, 1] * area[0, 1] + e[0, 2] * area[0, 2]
        sign = 1.0 if volume >= 0.0 else -1.0
        for k in range(4):
            volumes[four[k]] += sign * volume
        for c in range(3):
            first = displacement[four[0], c]
            x, y, z = (
                displacement[four[1], c] - first,
                displacement[four[2], c] - first,
                displacement[four[3], c] - first,
            )
            for d in range(3):
                own = sign * (x * area[0, d] + y * area[1, d] + z * area[2, d])
                for k in range(4):
                    gradients[four[k], c, d] += own


@njit(**_LOOP)
def _missing(nodes, tetrahedra, gradients):
    """Integrate the square of the sum of 4 a b m over the edges of each tetrahedron.

    a and b are the linear functions of an edge's ends, and m is what a quadratic function is at its
    middle beyond their mean: an eighth of the change of the gradient along it, times its length. In
    a tetrahedron of volume V the integral is 2 V / 105 times the square of the sum of all m, plus
    those of the sums at each node, plus those of each.
    """
    total = 0.0
    sums, e = np.empty(4), np.empty((3, 3))
    for t in range(len(tetrahedra)):
        four = tetrahedra[t]
        for k in range(3):
            for d in range(3):
                e[k, d] = nodes[four[k + 1], d] - nodes[four[0], d]
        volume = abs(
            e[0, 0] * (e[1, 1] * e[2, 2] - e[1, 2] * e[2, 1])
            + e[0, 1] * (e[1, 2] * e[2, 0] - e[1, 0] * e[2, 2])
            + e[0, 2] * (e[1, 0] * e[2, 1] - e[1, 1] * e[2, 0])
        )
        squares = 0.0
        for c in range(3):
            sums[:] = 0.0
            for i in range(1, 4):
                for j in range(i):
                    a, b = four[i], four[j]
                    m = 0.0
                    for d in range(3):
                        change = gradients[a, c, d] - gradients[b, c, d]
                        m += change * (nodes[a, d] - nodes[b, d])
                    m /= 8
                    sums[i] += m
                    sums[j] += m
                    squares += m * m
            whole = 0.0
            for k in range(4):
                whole += sums[k] / 2
                squares += sums[k] * sums[k]
            squares += whole * whole
        total += volume / 6 * 2 / 105 * squares
    return total
