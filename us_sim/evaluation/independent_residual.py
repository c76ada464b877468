"""How far a tissue is from balance, computed from what a solver returned and not by the solver.

Forces are those of `independent_forces`, derivatives of a method's energy at the returned nodes, so
that what a solver rounds, or leaves out, shows.

>>> from us_sim.evaluation.independent_forces import hooke_forces
>>> from us_sim.evaluation.independent_residual import SpringSettings, solid_residual
>>> from us_sim.tissue.model import TissueModel
>>> solid_residual(hooke_forces)(TissueModel.block(), SpringSettings()).is_least
False
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from us_sim.evaluation.independent_forces import (
    rounding_of_forces,
    spring_forces,
    volume_forces,
)
from us_sim.evaluation.push_directions import flared_distance, push_directions
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import interpolate
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.springs import fitted_springs, springs_of, volume_term
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import same_pose

Array = NDArray[np.float64]

_PARTS = 12
"""Parts of a triangle's sides, between which it is looked where a surface is pushed."""

_ALIKE = 7  # decimals in which directions of pushes differ that are not the same

_WAY = (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875)
"""Parts of a probe's way from pose to pose at which it is looked how deep it was."""

_DEEP = 0.35
"""Depth, over half the probe's smallest width, from which it may push in other directions than its
own. A solver may take it to be so from half of that, with tissue that has moved on the way."""

_SETTLED = 1e-5  # residual


@dataclass(frozen=True)
class SpringSettings:
    """How a method that has springs is set; the fields are named as its settings are."""

    stiffness: str = "algorithm_1"
    volume: bool = False  # whether tetrahedra keep their volumes


class IndependentResidual:
    """Checks the residuals of one run of a solver, frame by frame.

    Args:
        model: of the solver.
        forces: (N, 3) N that hold the nodes at displacements (N, 3) m, by the method's equations.
        rounding: N, norm of the forces that the last digit of the nodes' coordinates makes.
        surface: whether the probe pushes places on triangles, out of the shape of
            `flared_distance`, and not the nodes, as `push_directions` says. By how much it pushes
            is left open, so what is found is the least that the residual can be.
    """

    def __init__(
        self,
        model: TissueModel,
        forces: Callable[[Array], Array],
        rounding: float,
        *,
        surface: bool = False,
    ) -> None:
        self._model = model
        self._forces = forces
        self._rounding = rounding
        #: Whether a true residual may also be greater than what is found.
        self.is_least = surface
        self._surface = _touchable(model) if surface else np.zeros((0, 3), np.int32)
        self._spacing = model.contact_spacing or float(np.ptp(model.mesh.nodes, axis=0).min())
        self._last: tuple[Array, Pose | None] = model.mesh.nodes, None  # nodes that were returned
        self._swept = False  # whether the probe, where it is, came down deep in tissue
        self._settled = False  # as was reported last
        self._heaviest = 0.0
        self._scale = math.inf  # N, what the last residual referred to

    def forget(self) -> None:
        """The solver went back to an earlier state: loads before count no more."""
        self._heaviest = 0.0

    def check(self, deformation: Deformation, pose: Pose | None) -> tuple[float, float]:
        """Residual of the returned nodes, and the part of it that may be rounding of the nodes.

        As defined for `Deformation`: unbalanced over contact forces, where of what acts on touched
        nodes the part is balanced that is a sum of pushes by the probe. Without contact it refers
        to the heaviest contact before. Where a probe has come down deep in tissue, it is not known
        in which directions it pushes until the tissue has settled: the second is infinite then.
        """
        model = self._model
        if self.is_least:
            self._look_back(deformation, pose)
        with np.errstate(all="ignore"):
            holding = self._forces(deformation.nodes - model.mesh.nodes)
            unbalanced = np.where(model.fixed[:, None], 0.0, holding)
            touched = deformation.contact_nodes
            touched = touched[~model.fixed[touched]]
            load = 0.0
            if pose is not None and len(touched):
                if self.is_least:
                    push = self._on_triangles(pose, deformation.nodes, touched, holding)
                    # If the reported residual is true, contact forces are at most so great.
                    held, left = float(np.linalg.norm(holding[touched])), 1 - deformation.residual
                    load = held / left if left > 0.0 else math.inf
                else:
                    push = self._at_nodes(pose, deformation.nodes, touched, holding)
                    load = float(np.linalg.norm(push))
                unbalanced[touched] -= push
            imbalance = float(np.linalg.norm(unbalanced))
        if load == 0.0 and imbalance <= self._rounding:
            self._heaviest = 0.0  # at rest, or as good as
            return 0.0, self._rounding / self._scale
        self._heaviest = max(self._heaviest, load) or imbalance
        self._scale = load or self._heaviest
        rounding = math.inf if self._swept else self._rounding / self._scale
        return imbalance / self._scale, rounding

    def _look_back(self, deformation: Deformation, pose: Pose | None) -> None:
        """Find out whether the probe came down deep in tissue where it is, and that has not settled
        since.
        """
        (nodes, before), self._last = self._last, (deformation.nodes, pose)
        if pose is None:
            self._swept = False
        elif not same_pose(pose, before):
            box = self._model.collider.offset_box
            deep = _DEEP * float(box[:2].min() + box[3])
            places = _places(nodes, self._surface).reshape(-1, 3)
            # A solver may have gone a long way in strides, and come down on one of them.
            way = [interpolate(before, pose, part) for part in _WAY] if before else []
            for there in [*way, pose]:
                gap, _ = flared_distance(self._model.collider, there, places, self._spacing)
                self._swept = bool(gap.min(initial=np.inf) < -deep)
                if self._swept:
                    break
        elif self._settled:
            self._swept = False
        self._settled = deformation.residual <= _SETTLED

    def _at_nodes(
        self, pose: Pose, nodes: Array, touched: NDArray[np.integer], holding: Array
    ) -> Array:
        """(K, 3) N, of the forces that hold the touched nodes, what pushes these nodes."""
        model = self._model
        normal = push_directions(model.collider, pose, nodes[touched], model.contact_spacing)
        push = np.maximum(np.einsum("ij,ij->i", holding[touched], normal), 0.0)
        return np.asarray(push[:, None] * normal)

    def _on_triangles(
        self, pose: Pose, nodes: Array, touched: NDArray[np.integer], holding: Array
    ) -> Array:
        """(K, 3) N, of the forces that hold the touched nodes, the greatest part that is a sum of
        pushes square to the probe at places in it, on triangles of these nodes.
        """
        triangles = self._surface[np.isin(self._surface, touched).any(axis=1)]
        corners, places = nodes[triangles], _places(nodes, triangles)
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        gap, normal = flared_distance(
            self._model.collider, pose, places.reshape(-1, 3), self._spacing
        )
        # Within a part that is pushed at all, no corner is farther out than the part is long.
        near = gap.reshape(places.shape[:2]) <= sides.max(axis=1)[:, None] / _PARTS
        normal = normal.reshape(places.shape)
        push = np.zeros((len(touched), 3))
        for number, node in enumerate(touched):
            own = (triangles == node).any(axis=1)
            along = normal[own][near[own]]
            size = float(np.linalg.norm(holding[node]))
            if len(along) and size > 0.0:
                along = along[np.unique(along.round(_ALIKE), axis=0, return_index=True)[1]]
                push[number] = size * nnls(along.T, holding[node] / size)[0] @ along
        return push


Residual = Callable[[TissueModel, SpringSettings], IndependentResidual]
"""Makes what checks the residuals of one method on a model."""


def solid_residual(
    forces: Callable[[TetrahedralMesh, TissueMaterials, Array], Array], *, surface: bool = False
) -> Residual:
    """For a method of finite elements, whose nodes are held by those ``forces``.

    ``surface`` says whether its surface is pushed, or its nodes, as for `IndependentResidual`.
    """

    def residual(model: TissueModel, _: SpringSettings) -> IndependentResidual:
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


def spring_residual(*, yielding: bool) -> Residual:
    """For a method of springs, whose volume term yields as `volume_forces` says, or does not."""

    def residual(model: TissueModel, settings: SpringSettings) -> IndependentResidual:
        mesh, materials = model.mesh, model.materials
        made = springs_of if settings.stiffness == "algorithm_1" else fitted_springs
        springs = made(mesh, materials)
        term = volume_term(mesh, materials, springs) if settings.volume else None

        def forces(displacement: Array) -> Array:
            force = spring_forces(springs.edges, springs.stiffness, mesh.nodes, displacement)
            if term is not None:
                force += volume_forces(
                    mesh, term.element, term.nodal, displacement, yielding=yielding
                )
            return force

        digit = np.finfo(np.float64).eps * np.abs(mesh.nodes).max()
        rounding = 4 * digit * float(np.linalg.norm(springs.stiffness))
        if term is not None:
            rounding += rounding_of_forces(mesh, term.element + term.nodal)
        return IndependentResidual(model, forces, rounding)

    return residual


def _touchable(model: TissueModel) -> NDArray[np.integer]:
    """(T, 3) triangles that the probe can push; what is touched alone is one with no extent."""
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
