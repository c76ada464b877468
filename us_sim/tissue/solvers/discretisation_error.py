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
>>> interpolation_error(mesh, mesh.nodes @ np.ones((3, 3)))[0] < 1e-12  # linear: none
True
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.complementarity import predict_forces
from us_sim.tissue.contact.probe_gap import FlaredProbe
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.linear_algebra.compliance import SurfaceCompliance
from us_sim.tissue.mesh.tetrahedral_mesh import EDGES, TetrahedralMesh
from us_sim.tissue.model import TissueModel


def relative_error(
    model: TissueModel,
    compliance: SurfaceCompliance,
    pose: Pose | None,
    displacement: NDArray[np.float64],
    forces: NDArray[np.float64],
    reach: float,
) -> float:
    """Relative L2 error of a displacement that is not zero, estimated.

    Args:
        model: of the tissue and the probe.
        compliance: of the surface that the probe can touch.
        pose: of the probe, None where there is none.
        displacement: (N, 3) m.
        forces: (N, 3) N, of contact.
        reach: m, nodes farther from the probe stay untouched.
    """
    missing, moved = interpolation_error(model.mesh, displacement)
    apart = 0.0
    if pose is not None:
        closing = contact_error(model, compliance, pose, displacement, forces, reach)
        apart = float(np.linalg.norm(closing) / np.linalg.norm(displacement))
    return math.hypot(missing / moved, apart)


def contact_error(
    model: TissueModel,
    compliance: SurfaceCompliance,
    pose: Pose,
    displacement: NDArray[np.float64],
    forces: NDArray[np.float64],
    reach: float,
) -> NDArray[np.float64]:
    """(N, 3) m, how linear tissue moves from the contact that it has to one of its nodes alone.

    The arguments are those of `relative_error`.
    """
    nodes = compliance.nodes
    places = model.mesh.nodes[nodes] + displacement[nodes]
    gap, normal = FlaredProbe(model.collider, model.contact_spacing).distance(pose, places)
    held = np.ascontiguousarray(forces[nodes])
    change = predict_forces(compliance.matrix, gap, normal, held, np.zeros(len(nodes)), reach)
    return compliance.field(change)


def force_error(
    mesh: TetrahedralMesh, materials: TissueMaterials, displacement: NDArray[np.float64]
) -> float:
    """By how much, relative, the mesh is too stiff for a displacement (N, 3) m that is not zero.

    >>> from us_sim.tissue.model import TissueModel
    >>> block = TissueModel.block((1.0, 1.0, 1.0), (5, 5, 5))
    >>> x, _, z = block.mesh.nodes.T - [[0.0], [0.0], [0.5]]
    >>> bent = 1e-6 * np.stack([-x * z, 0 * x, 0 * x], axis=1)
    >>> 0.02 < force_error(block.mesh, block.materials, bent) < 0.2  # four cells across: 1 / 15
    True
    """
    slope = np.einsum("eai,eaj->eij", displacement[mesh.tetrahedra], shape_gradients(mesh))
    slope += np.eye(3)
    strain = np.einsum("eki,ekj->eij", slope, slope) / 2  # Green's, and half the unit matrix
    strain -= np.einsum("ekk->e", strain)[:, None, None] * np.eye(3) / 3
    strain = strain.reshape(-1, 9)
    shear = mesh.volumes * materials.young_modulus / (2 * (1 + materials.poisson_ratio))
    lacking = _nodal_mean(mesh, shear, strain)[mesh.tetrahedra] - strain[:, None]
    squares = (lacking**2).sum(axis=(1, 2)) + (lacking.sum(axis=1) ** 2).sum(axis=1)
    return float(shear @ squares / 20 / (shear @ (strain**2).sum(axis=1)))


def interpolation_error(
    mesh: TetrahedralMesh, displacement: NDArray[np.float64]
) -> tuple[float, float]:
    """L2 norms over the volume, in m times the root of m3, of the quadratic functions that a
    displacement (N, 3) m misses, and of itself.
    """
    slope = np.einsum("eac,ead->ecd", displacement[mesh.tetrahedra], shape_gradients(mesh))
    gradients = _nodal_mean(mesh, mesh.volumes, slope.reshape(-1, 9)).reshape(-1, 3, 3)
    # On each edge, with a and b the linear functions of its ends, 4 a b m is missing. m is what a
    # quadratic function is at the edge's middle beyond their mean: an eighth of the change of the
    # gradient along it, times its length. The integral of the square of the sum over a tetrahedron
    # of volume V is 2 V / 105 times the square of the sum of all m, plus those of the sums at each
    # node, plus those of each.
    ends = mesh.tetrahedra[:, EDGES]  # (M, 6, 2)
    change = gradients[ends[..., 0]] - gradients[ends[..., 1]]
    beyond = np.einsum("mecd,med->mec", change, mesh.nodes[ends[..., 0]] - mesh.nodes[ends[..., 1]])
    beyond /= 8
    at_node = np.stack(
        [beyond[:, np.any(k == EDGES, axis=1)].sum(axis=1) for k in range(4)], axis=1
    )
    squares = (beyond**2).sum(axis=(1, 2)) + (at_node**2).sum(axis=(1, 2))
    squares += (beyond.sum(axis=1) ** 2).sum(axis=1)
    missing = 2 / 105 * float(mesh.volumes @ squares)
    volumes = np.bincount(mesh.tetrahedra.ravel(), np.repeat(mesh.volumes / 4, 4), len(mesh.nodes))
    return math.sqrt(missing), math.sqrt(float(volumes @ (displacement**2).sum(axis=1)))


def _nodal_mean(
    mesh: TetrahedralMesh, weight: NDArray[np.float64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N, K), the mean of tetrahedra's values (M, K) around each node, by their weight (M,)."""
    around, count = mesh.tetrahedra.ravel(), len(mesh.nodes)
    weighted = np.repeat(weight[:, None] * values, 4, axis=0)
    total = np.stack([np.bincount(around, column, count) for column in weighted.T], axis=1)
    return np.asarray(total / np.bincount(around, np.repeat(weight, 4), count)[:, None])
