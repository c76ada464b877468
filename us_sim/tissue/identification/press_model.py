"""What a press feels like for given Young's moduli: wrenches at its poses, and their slopes.

From pose to pose the tissue of `fem_nonlinear` is brought to balance, without friction and
viscosity. It always begins at rest and goes the whole way, since tissue that is pressed hard may
come to balance in more than one place.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.identification.press_model import PressModel
>>> from us_sim.tissue.model import TissueModel
>>> model = TissueModel.block(nodes=(5, 5, 5))
>>> press = PressModel(
...     model,
...     lambda moduli: uniform_material(model.mesh, Material(moduli["gel"], 0.45)),
...     ["gel"],
...     [Pose(position=[0.0, 0.0, 0.01])],
... )
>>> felt = press.predict({"gel": 10e3})
>>> felt.wrenches.shape, felt.slopes.shape
((1, 6), (1, 6, 1))
>>> bool(abs(felt.slopes[0, 2, 0] / felt.wrenches[0, 2] - 1) < 1e-3)
True
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import StiffnessError
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.identification.pressed_tissue import PressedTissue, slopes
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear, FemNonlinearSettings

MaterialsFor = Callable[[Mapping[str, float]], TissueMaterials]
"""The constants of all tetrahedra, from Young's moduli (Pa) by structure."""

_STEP = 1e-5
"""Change of a modulus' logarithm by which forces are compared."""

_FRAMES, _BALANCED = 200, 1e-3
"""Frames for a pose at most, and the residual with which it must end."""

Progress = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class Felt:
    """What is felt and seen at K poses, and its slopes by the logarithms of P moduli."""

    wrenches: NDArray[np.float64]  # (K, 6) N and N m, on the probe about its origin, frame probe
    slopes: NDArray[np.float64]  # (K, 6, P)
    places: NDArray[np.float64]  # (S, 3) m, of points seen
    place_slopes: NDArray[np.float64]  # (S, 3, P) m


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of the tissue that are seen at some of the poses."""

    poses: NDArray[np.intp]  # (S,) number of the pose
    rest: NDArray[np.float64]  # (S, 3) m, where they are in the undeformed tissue
    nodes: NDArray[np.int32]  # (S, 4) that carry them
    weights: NDArray[np.float64]  # (S, 4)

    @classmethod
    def none(cls) -> SeenPoints:
        """No point."""
        return cls(
            np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 4), np.int32), np.zeros((0, 4))
        )


class PressModel:
    """A tissue and the poses at which a probe presses it.

    Args:
        model: of tissue and probe; its materials do not count.
        materials_for: makes those of given moduli.
        names: of the P structures whose moduli vary.
        poses: K, in the order in which they were gone to.
        seen: points that are observed as well.
    """

    def __init__(
        self,
        model: TissueModel,
        materials_for: MaterialsFor,
        names: Sequence[str],
        poses: Sequence[Pose],
        seen: SeenPoints | None = None,
    ) -> None:
        self.names = tuple(names)
        self._model, self._materials_for, self._poses = model, materials_for, list(poses)
        self._seen = seen or SeenPoints.none()
        self._settings = FemNonlinearSettings()

    def predict(self, moduli: Mapping[str, float], progress: Progress | None = None) -> Felt:
        """What is felt with these moduli (Pa), of all structures.

        Raises:
            SolverError: the tissue cannot be solved.
            StiffnessError: it does not come to balance at a pose.
        """
        varied = [{**moduli, name: moduli[name] * float(np.exp(_STEP))} for name in self.names]
        solver = self.solver(moduli)
        tissue = PressedTissue(solver.model)
        others = [PressedTissue(self._with(each)) for each in varied]
        wrenches = np.empty((len(self._poses), 6))
        changes = np.empty((len(self._poses), 6, len(self.names)))
        places = self._seen.rest.copy()
        place_slopes = np.zeros((*self._seen.rest.shape, len(self.names)))
        for k, pose in enumerate(self._poses):
            if progress is not None:
                progress(k / len(self._poses), "pressing")
            moved = self.balanced(solver, pose, k)
            field = np.ascontiguousarray(moved.T)
            found = slopes(tissue, others, _STEP, pose, field)
            tissue.put(pose, field)
            wrenches[k], changes[k] = tissue.wrench, found.wrench
            for s in np.flatnonzero(self._seen.poses == k):
                nodes, weights = self._seen.nodes[s], self._seen.weights[s]
                places[s] += weights @ moved[nodes]
                place_slopes[s] = (found.displacement[:, :, nodes] @ weights).T
        return Felt(wrenches, changes, places, place_slopes)

    def solver(self, moduli: Mapping[str, float]) -> FemNonlinear:
        """The tissue of these moduli (Pa), at rest."""
        return FemNonlinear(self._with(moduli), self._settings)

    def _with(self, moduli: Mapping[str, float]) -> TissueModel:
        return replace(self._model, materials=self._materials_for(moduli))

    def balanced(self, solver: FemNonlinear, pose: Pose, k: int = 0) -> NDArray[np.float64]:
        """(N, 3) m, displacement at a pose, the k-th, to which the solver goes from where it is.

        Raises:
            StiffnessError: the tissue does not come to balance.
        """
        for _ in range(_FRAMES):
            deformation = solver.deform(pose)
            if solver.is_settled:
                break
        if not deformation.residual <= _BALANCED:
            raise StiffnessError(
                f"the tissue does not come to balance at pose {k + 1} of {len(self._poses)} "
                f"({deformation.action or f'residual {deformation.residual:.2g}'}): is the press "
                f"deeper than tissue yields, or the mesh too coarse for it?"
            )
        return deformation.nodes - self._model.mesh.nodes
