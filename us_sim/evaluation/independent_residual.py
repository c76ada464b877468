"""The residual of a tissue, from the nodes that a solver returned and by other code.

Forces are those of `independent_forces`, derivatives of a method's energy, so that rounding and
omissions of a solver show; directions of the probe's contact forces are written down a second time.

>>> from us_sim.evaluation.independent_forces import hooke_forces
>>> from us_sim.geometry.collider import RoundedBox, Sphere
>>> solid_residual(hooke_forces)(TissueModel.block(), MsdsSettings()).is_least
False
>>> contact_directions(Sphere(0.03), Pose(), np.array([[0.0, 0.0, 0.0]]), 0.005)
array([[0., 0., 1.]])
>>> box = RoundedBox(0.04, 0.014, 0.03, 0.004)
>>> distance, normal = flared_distance(box, Pose(), np.array([[0.022, 0.0, -0.005]]), 0.006)
>>> distance.round(6), normal.round(3)
(array([0.000696]), array([[0.866, 0.   , 0.5  ]]))
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from us_sim.evaluation.independent_forces import rounding_of_forces, spring_forces, volume_forces
from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose, same_pose
from us_sim.geometry.se3 import interpolate
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.springs import fitted_springs, springs_of, volume_term
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import Deformation, TissueModel

Array = NDArray[np.float64]

_PARTS = 12  # parts of a triangle's sides, between which places of contact are sampled


@dataclass(frozen=True)
class MsdsSettings:
    """Settings of methods with springs, by their names."""

    stiffness: str = "algorithm_1"
    volume: bool = False  # whether tetrahedra keep their volumes


class IndependentResidual:
    """Checks the residuals of one run of a solver, frame by frame.

    Args:
        model: of the solver.
        forces: (N, 3) N that hold the nodes at displacements (N, 3) m, by the method's equations.
        rounding: N, norm of the forces that the last digit of the nodes' coordinates makes.
        surface: whether contact forces act at places on triangles, square to the shape of
            `flared_distance`, and not at nodes along `contact_directions`. Their sizes are open, so
            the least residual is found.
    """

    def __init__(
        self,
        model: TissueModel,
        forces: Callable[[Array], Array],
        rounding: float,
        *,
        surface: bool = False,
    ) -> None:
        self._model, self._forces, self._rounding = model, forces, rounding
        #: Whether a true residual may also be greater than the returned one.
        self.is_least = surface
        self._surface = _touchable(model) if surface else np.zeros((0, 3), np.int32)
        self._spacing = model.contact_spacing or float(np.ptp(model.mesh.nodes, axis=0).min())
        self._last: tuple[Array, Pose | None] = model.mesh.nodes, None
        self._deep = False  # whether the probe came down deep in tissue that has not settled since
        self._settled = False  # as was reported last
        self._heaviest = 0.0
        self._scale = math.inf  # N, to which the last residual referred

    def forget(self) -> None:
        """Forget earlier loads: the solver went back to an earlier state."""
        self._heaviest = 0.0

    def check(self, deformation: Deformation, pose: Pose | None) -> tuple[float, float]:
        """Residual of the returned nodes, and the part of it that may be rounding of the nodes.

        As defined for `Deformation`: unbalanced over contact forces; of the forces on touched nodes
        the part is balanced that is a sum of contact forces. Without contact it refers to the
        heaviest contact before. Where a probe has come down deep in tissue, the directions of its
        forces are unknown until the tissue has settled: the second number is infinite then.
        """
        model = self._model
        if self.is_least:
            self._update_depth(deformation, pose)
        with np.errstate(all="ignore"):
            holding = self._forces(deformation.nodes - model.mesh.nodes)
            unbalanced = np.where(model.fixed[:, None], 0.0, holding)
            touched = deformation.contact_nodes
            touched = touched[~model.fixed[touched]]
            load = 0.0
            if pose is not None and len(touched):
                if self.is_least:
                    contact = self._on_triangles(pose, deformation.nodes, touched, holding)
                    # If the reported residual is true, contact forces are at most so great.
                    held, left = float(np.linalg.norm(holding[touched])), 1 - deformation.residual
                    load = held / left if left > 0.0 else math.inf
                else:
                    contact = self._at_nodes(pose, deformation.nodes, touched, holding)
                    load = float(np.linalg.norm(contact))
                unbalanced[touched] -= contact
            residual_norm = float(np.linalg.norm(unbalanced))
        if load == 0.0 and residual_norm <= self._rounding:
            self._heaviest = 0.0  # at rest, or as good as
            return 0.0, self._rounding / self._scale
        self._heaviest = max(self._heaviest, load) or residual_norm
        self._scale = load or self._heaviest
        rounding = math.inf if self._deep else self._rounding / self._scale
        return residual_norm / self._scale, rounding

    def _update_depth(self, deformation: Deformation, pose: Pose | None) -> None:
        """Note whether the probe is so deep in the tissue that it may push in unknown directions.

        That is 0.35 of half its smallest width. A solver may assume it from half that depth on, for
        the tissue moves on the way.
        """
        (nodes, before), self._last = self._last, (deformation.nodes, pose)
        if pose is None:
            self._deep = False
        elif not same_pose(pose, before):
            box = self._model.collider.offset_box
            deep = 0.35 * float(box[:2].min() + box[3])
            places = _places(nodes, self._surface).reshape(-1, 3)
            # A solver may have gone a long way in strides, and come down on one of them.
            way = [interpolate(before, pose, k / 8) for k in range(1, 8)] if before else []
            for there in [*way, pose]:
                gap, _ = flared_distance(self._model.collider, there, places, self._spacing)
                self._deep = bool(gap.min(initial=np.inf) < -deep)
                if self._deep:
                    break
        elif self._settled:
            self._deep = False
        self._settled = deformation.residual <= 1e-5

    def _at_nodes(
        self, pose: Pose, nodes: Array, touched: NDArray[np.integer], holding: Array
    ) -> Array:
        """(K, 3) N, the part of the touched nodes' forces that the probe balances."""
        model = self._model
        normal = contact_directions(model.collider, pose, nodes[touched], model.contact_spacing)
        size = np.maximum(np.einsum("ij,ij->i", holding[touched], normal), 0.0)
        return np.asarray(size[:, None] * normal)

    def _on_triangles(
        self, pose: Pose, nodes: Array, touched: NDArray[np.integer], holding: Array
    ) -> Array:
        """(K, 3) N, the greatest part of the touched nodes' forces that is a sum of forces square
        to the probe at places in it, on triangles of these nodes.
        """
        triangles = self._surface[np.isin(self._surface, touched).any(axis=1)]
        corners, places = nodes[triangles], _places(nodes, triangles)
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        gap, normal = flared_distance(
            self._model.collider, pose, places.reshape(-1, 3), self._spacing
        )
        # Within a part in contact, no corner is farther out than the part is long.
        near = gap.reshape(places.shape[:2]) <= sides.max(axis=1)[:, None] / _PARTS
        normal = normal.reshape(places.shape)
        contact = np.zeros((len(touched), 3))
        for number, node in enumerate(touched):
            own = (triangles == node).any(axis=1)
            along = normal[own][near[own]]
            size = float(np.linalg.norm(holding[node]))
            if len(along) and size > 0.0:
                along = along[np.unique(along.round(7), axis=0, return_index=True)[1]]
                contact[number] = size * nnls(along.T, holding[node] / size)[0] @ along
        return contact


Residual = Callable[[TissueModel, MsdsSettings], IndependentResidual]
"""Makes the independent residual of one method on a model."""


def solid_residual(
    forces: Callable[[TetrahedralMesh, TissueMaterials, Array], Array], *, surface: bool = False
) -> Residual:
    """For a method of finite elements, whose nodes are held by those ``forces``.

    ``surface`` says whether its surface is pushed, or its nodes, as for `IndependentResidual`.
    """

    def residual(model: TissueModel, _: MsdsSettings) -> IndependentResidual:
        mesh, materials = model.mesh, model.materials
        shear = materials.young_modulus / (2 * (1 + materials.poisson_ratio))
        stiffest = shear / (1 - 2 * materials.poisson_ratio) + shear
        return IndependentResidual(
            model,
            lambda displacement: forces(mesh, materials, displacement),
            rounding_of_forces(mesh, stiffest),
            surface=surface,
        )

    return residual


def spring_residual(model: TissueModel, settings: MsdsSettings) -> IndependentResidual:
    """For `msds`, whose volume term yields as `volume_forces` says."""
    mesh, materials = model.mesh, model.materials
    made = springs_of if settings.stiffness == "algorithm_1" else fitted_springs
    springs = made(mesh, materials)
    term = volume_term(mesh, materials, springs) if settings.volume else None

    def forces(displacement: Array) -> Array:
        force = spring_forces(springs.edges, springs.stiffness, mesh.nodes, displacement)
        if term is not None:
            force += volume_forces(mesh, term.element, term.nodal, displacement, yielding=True)
        return force

    digit = np.finfo(np.float64).eps * np.abs(mesh.nodes).max()
    rounding = 4 * digit * float(np.linalg.norm(springs.stiffness))
    if term is not None:
        rounding += rounding_of_forces(mesh, term.element + term.nodal)
    return IndependentResidual(model, forces, rounding)


def _touchable(model: TissueModel) -> NDArray[np.integer]:
    """(T, 3) triangles that the probe can touch; a node that is touched alone is a point."""
    reached = np.zeros(len(model.mesh.nodes), dtype=bool)
    reached[model.contact_nodes] = True
    triangles = model.mesh.boundary
    held = model.fixed[triangles].all(axis=1)
    triangles = triangles[reached[triangles].all(axis=1) & ~held]
    alone = np.setdiff1d(model.contact_nodes, triangles)
    return np.concatenate([triangles, np.repeat(alone[:, None], 3, axis=1)])


def _places(nodes: Array, triangles: NDArray[np.integer]) -> Array:
    """(T, L, 3) m, places on triangles (T, 3) of nodes (N, 3) m."""
    return np.asarray(np.einsum("lk,tkd->tld", _lattice(_PARTS), nodes[triangles]))


def _lattice(count: int) -> Array:
    """(L, 3) barycentric coordinates of the corners of a triangle's count^2 equal parts."""
    row, column = np.divmod(np.arange((count + 1) ** 2), count + 1)
    first = np.column_stack([row, column])[row + column <= count] / count
    return np.column_stack([first, 1 - first.sum(axis=1)])


_GRIP = 0.1  # m, how far the probe is taken to go on behind its collider

_LEAN, _FLARE = math.radians(60), 0.6
"""Angle of flanks to the face, and how much wider they become, over the nodes' spacing."""

_ON = 1e-12  # m; what is as near to an outline lies on it


def contact_directions(collider: Collider, pose: Pose, points: Array, spacing: float) -> Array:
    """(K, 3) unit directions in which the probe pushes points (K, 3) m on or in it.

    The rule of `us_sim.tissue.contact.probe_gap.push_out`, written down again.
    """
    box = collider.offset_box
    rounding = box[3]
    if rounding < 2 * spacing:
        return np.broadcast_to(pose.rotation[:, 2], points.shape)
    local = (points - pose.position) @ pose.rotation
    side = np.where(local[:, :2] >= 0, 1.0, -1.0)
    out = np.maximum(np.abs(local[:, :2]) - box[:2], 0.0)
    rise = np.sqrt(np.maximum(rounding**2 - (out**2).sum(axis=1), 0.0))
    ahead = local[:, 2] + rounding
    behind = -(ahead + 2 * box[2] + _GRIP)
    up = np.maximum(ahead, 0.0) - np.maximum(behind, 0.0)
    length = np.sqrt((out**2).sum(axis=1) + up**2)
    near = (length >= rounding) | ((length > 0.5 * rounding) & (up >= 0))
    radial = np.column_stack([side * out, up]) / np.maximum(length, 1e-300)[:, None]
    from_above = np.column_stack([side * out, rise]) / rounding
    return np.where(near[:, None], radial, from_above) @ pose.rotation.T


def flared_distance(
    collider: Collider, pose: Pose, points: Array, spacing: float
) -> tuple[Array, Array]:
    """Distance of points (P, 3) m to a probe with leaning flanks, and its outward normals there.

    The shape of `us_sim.tissue.contact.probe_gap.FlaredProbe`, written down again: an outline in
    the plane of the image, that of its distance and y around it, and the rounding around both.

    Returns:
        (P,) m, negative inside, infinite behind the shape, and (P, 3).
    """
    box = collider.offset_box
    rounding, length = float(box[3]), 2 * float(box[2]) + _GRIP
    flare = 0.0 if rounding >= 2 * spacing else _FLARE * spacing
    local = (points - pose.position) @ pose.rotation
    side, beside = np.where(local >= 0, 1.0, -1.0), np.abs(local)
    ahead = local[:, 2] + rounding
    half, bent = float(box[0]), float(box[4]) if len(box) > 4 else 0.0
    in_plane = np.column_stack([beside[:, 0], ahead])
    if bent:
        # Flanks that would lean less than the front's end go straight back.
        widened = flare if half * bent <= math.sin(_LEAN) else 0.0
        across, along = _outside(*_arc(in_plane, half, 1 / bent), in_plane, widened, length)
    else:
        across, along = _outside(*_line(in_plane, half), in_plane, flare, length)
    in_plane = np.column_stack([beside[:, 1], across])
    found, out = _outside(*_line(in_plane, float(box[1])), in_plane, flare, length)
    turn = out[:, 1:] * along
    normal = np.column_stack([side[:, 0] * turn[:, 0], side[:, 1] * out[:, 0], turn[:, 1]])
    return np.where(ahead + length > 0.0, found - rounding, np.inf), normal @ pose.rotation.T


def _line(points: Array, half: float) -> tuple[Array, Array, Array]:
    """The place on a straight front that is nearest to points (P, 2) m, its normal there, and its
    end.
    """
    foot = np.column_stack([np.minimum(points[:, 0], half), np.zeros(len(points))])
    return foot, np.broadcast_to([0.0, 1.0], points.shape), np.array([half, 0.0])


def _arc(points: Array, half: float, radius: float) -> tuple[Array, Array, Array]:
    """As `_line`, on an arc that begins at the origin and ends ``half`` beside it."""
    angle = np.minimum(np.arctan2(points[:, 0], points[:, 1] + radius), math.asin(half / radius))
    normal = np.column_stack([np.sin(angle), np.cos(angle)])
    end = np.array([half, math.sqrt(radius**2 - half**2) - radius])
    return radius * normal - [0.0, radius], normal, end


def _outside(
    front: Array, front_normal: Array, end: Array, points: Array, flare: float, length: float
) -> tuple[Array, Array]:
    """Signed distance of points (P, 2) m to an outline, and its normal there.

    Args:
        front: (P, 2) m, places on its front that are nearest to the points.
        front_normal: (P, 2), of the front there.
        end: (2,) m, of the front; there the flank begins.
        points: (P, 2) m, beside the outline's middle and ahead.
        flare: m, by which the flank becomes wider.
        length: m, from there straight back.
    """
    rim = end + np.array([flare, -flare * math.tan(_LEAN)])
    back = rim - np.array([0.0, length])
    corners = [end, rim, back] if flare else [end, back]
    feet, normals = [front], [front_normal]
    for start, stop in pairwise(corners):
        way = stop - start
        part = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
        feet.append(start + part[:, None] * way)
        square = np.array([-way[1], way[0]]) / math.hypot(*way)
        normals.append(np.broadcast_to(square, points.shape))
    away = points[:, None] - np.stack(feet, axis=1)
    normal = np.stack(normals, axis=1)
    height = (away * normal).sum(axis=2)  # above the planes through what is nearest
    reach = np.linalg.norm(away, axis=2)
    inside = height.max(axis=1) <= _ON
    nearest = np.where(inside, height.argmax(axis=1), reach.argmin(axis=1))
    each = np.arange(len(points))
    far, square = reach[each, nearest], normal[each, nearest]
    direction = away[each, nearest] / np.maximum(far, _ON)[:, None]
    return (
        np.where(inside, height[each, nearest], far),
        np.where(inside[:, None], square, direction),
    )
