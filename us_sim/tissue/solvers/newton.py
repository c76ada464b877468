"""Newton's method for the energy of tissue and contact together: every step lowers it.

The energy is that of `neo_hookean` and of `penalty_contact`, where asked for also of
`penalty_friction` and `overstress`. A step minimises its quadratic model, in which nodes come to
touch and are let go as the displacement says, by conjugate gradients with the exact tangent; then a
line search takes as much of it as lowers the energy itself. Where the tangent is indefinite or a
step had to be cut, the model is made stiffer (K. Levenberg, A method for the solution of certain
non-linear problems in least squares, Q. Appl. Math. 2, 1944), and softer again as steps succeed.
The iterates may be inside out, which the energy allows for; whoever shows them has to wait.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.newton import Newton
>>> newton = Newton(TissueModel.block(nodes=(5, 5, 5)))
>>> newton.aim(Pose(position=[0.0, 0.0, 0.005]))
>>> unbalanced, energy = newton.imbalance, newton.energy
>>> all(newton.step(20) for _ in range(6))
True
>>> newton.imbalance < 1e-3 * unbalanced, newton.energy < energy
(True, True)

Poses on the way of a probe, so that tissue is swept aside and not left where it was hit.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.solvers.newton import strides
>>> [pose.position.tolist() for pose in strides(Pose(), Pose([0.0, 0.0, 0.008]), 0.008, arm=0.02)]
[[0.0, 0.0, 0.0026666666666666666], [0.0, 0.0, 0.005333333333333333]]
>>> [f"{pose.position[2]:.3f}" for pose in strides(None, Pose([0, 0, 0.03]), 0.006, arm=0.02)]
['0.027']
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import interpolate
from us_sim.tissue.contact.surface_points import add_springs, add_turns, surface_contact
from us_sim.tissue.elasticity.neo_hookean import NeoHookean, Overstress, PronyBranch
from us_sim.tissue.linear_algebra.sparse_factors import FactoredStiffness
from us_sim.tissue.linear_algebra.two_level import (
    CoarseGrid,
    Preconditioner,
    TwoLevel,
    add_blocks,
    clear_nodes,
    conjugate_gradients,
    largest_local_eigenvalue,
)
from us_sim.tissue.model import TissueModel

_SINGLE_CONTRAST = 1e4
"""Ratio of Young's moduli beyond which rounding in single precision hides the softer forces."""

_SINGLE_BULK = 1e3
"""Bulk over shear modulus beyond which rounding in single precision hides the shear's forces."""

_LEAST_PATIENCE = 12
"""Iterations of the first step: solved further, a step after a large change overshoots. Those after
it may take twice as many as long as steps need not be cut."""

_SMALL = 500
"""Free nodes up to which a factor of the stiffness takes no longer than a frame."""

_MOST_PATIENCE, _MOST_PATIENCE_SMALL = 100, 45
"""Iterations beyond which a factor of the stiffness takes less time, the latter up to that size."""

_BACKTRACKS = 8
"""Step lengths that are tried, each half the last."""

_FORCING, _AIM = 0.2, 0.3
"""A step ends when its model's unbalanced forces have fallen to this fraction, or to this fraction
of the goal. Lower is no use: the next step has a new tangent."""

_SEGMENT = 12
"""Iterations after which the model looks anew which nodes touch; then twice as many."""

_ROUNDING = 1e-12
"""Fraction of the energy by which rounding may seem to raise it."""

_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 0.01, 0.001, 1e3
"""Stiffness added after a step that was cut, over the tissue's own at rest; and its range."""

_LOCAL_WEIGHT = 12.0
"""Weight of the local preconditioner, over the largest eigenvalue of the locally preconditioned
stiffness at rest; 1 to 25 were tried."""


class Newton:
    """A state of the tissue, the forces in it, and steps towards their balance.

    Args:
        model: of the tissue and the probe.
        friction: Coulomb's coefficient, infinite for a probe to which tissue sticks.
        branch: of viscous tissue.
    """

    def __init__(
        self, model: TissueModel, friction: float = 0.0, branch: PronyBranch | None = None
    ) -> None:
        self._model = model
        self._factored: FactoredStiffness | None = None  # made where it is first needed
        #: Whether a factor takes no longer than a frame.
        self.is_small = int((~model.fixed).sum()) <= _SMALL
        self._most_patience = _MOST_PATIENCE_SMALL if self.is_small else _MOST_PATIENCE
        #: Whether a step may take the time to factor the stiffness.
        self.may_factor = False
        mesh, modulus = model.mesh, model.materials.young_modulus
        bulk = 1 / (1 - 2 * model.materials.poisson_ratio.max())  # lambda + mu over mu
        single = modulus.max() <= _SINGLE_CONTRAST * modulus.min() and bulk <= _SINGLE_BULK
        self._dtype: type[np.floating] = np.float32 if single else np.float64
        self.tissue = NeoHookean(mesh, model.materials, np.float64)
        # Conjugate gradients only correct; what they correct is in double precision.
        self._tangent = NeoHookean(mesh, model.materials, self._dtype)
        self._fixed = np.flatnonzero(model.fixed)
        self.overstress: Overstress | None = None
        if branch is not None:
            single = NeoHookean(mesh, model.materials, self._dtype)
            self.overstress = Overstress(branch, self.tissue, single)
        stiffened = self.overstress.stiffened if self.overstress else None
        product = stiffened or self.tissue.tangent_product
        grid = CoarseGrid(mesh, model.fixed, product, self._dtype)
        rest = self.tissue.diagonal_blocks()
        self._rest_blocks: NDArray[np.floating] = rest.astype(self._dtype)
        most = largest_local_eigenvalue(rest, self.tissue.tangent_product, self._fixed)
        self._two_level = TwoLevel(grid, self._fixed, _LOCAL_WEIGHT / most)
        self.points, self.contact = surface_contact(model, friction)
        self.displacement = np.zeros((3, len(mesh.nodes)))  # m
        self._force = np.zeros_like(self.displacement)  # N, the slope of the tissue's energy
        self.rest()

    def rest(self) -> None:
        """Put the tissue to rest: undeformed, and touched nowhere."""
        self.displacement = np.zeros_like(self.displacement)
        self._places = self.points.rest  # (P, 3) m, where the points near the probe are
        self.contact.clear()
        self._carried = 0.0  # N, contact forces of that state, until a step is taken from there
        self._held = self.contact.push  # (P,) N, pushes of the last state that was not just hit
        if self.overstress is not None:
            self.overstress.forget(self.displacement)
        self._damping = 0.0
        self.patience = _LEAST_PATIENCE  # iterations that the next step may take
        self._factors = False  # whether factors have been needed since
        self._weigh()

    def depth_at_rest(self, pose: Pose) -> float:
        """How deep (m) a probe would be in the undeformed tissue."""
        return self.contact.depth(pose, self.points.rest)

    def depth(self, pose: Pose) -> float:
        """How deep (m) a probe would be in the tissue as it is."""
        return self.contact.depth(pose, self.points.placed(self.displacement))

    def aim(self, pose: Pose) -> None:
        """Put the probe at a pose, and weigh the forces; nothing moves."""
        self._held = self.contact.push
        self._carried = self.load
        self._places = self.points.placed(self.displacement)
        self.contact.aim(pose, self._places)
        self._damping = _DAMPING
        self.patience = _LEAST_PATIENCE
        self._press()

    def lift(self) -> None:
        """Take the probe away, and weigh the forces; nothing moves."""
        self.contact.clear()
        self._held = self.contact.push
        self._damping = 0.0
        self._press()

    def relax(self) -> None:
        """Let the time from frame to frame pass; nothing moves."""
        if self.overstress is not None:
            self.overstress.relax(self.displacement)
            self._weigh()

    def settle(self) -> float:
        """End a frame with the probe at rest; returns by how much tissue may move for it, m."""
        change = self.contact.settle()
        self._places = self.points.placed(self.displacement)
        if self.contact.release(self._places):
            change = np.inf
        self._press()
        return change

    def expect(self, push: NDArray[np.float64]) -> None:
        """Learn which pushes (P,) N on the surface are likely at the pose; nothing moves."""
        if self.contact.expect(push):
            self._press()

    def put(self, displacement: NDArray[np.float64]) -> None:
        """Put the tissue elsewhere: (3, N) m."""
        self._move(displacement)
        self._weigh()

    def _move(self, displacement: NDArray[np.float64]) -> None:
        """Let the tissue be there, and measure the gaps to the probe."""
        self.displacement = displacement
        self._places = self.points.placed(displacement, self.contact.near)
        self.contact.look(self._places)

    def _weigh(self, energy: float | None = None) -> None:
        """The energy, unless `_energy` has just been asked for it, and its slope."""
        self.energy = self._energy() if energy is None else energy  # J
        if self.overstress is not None:
            self.overstress.add_forces(self.displacement, self._force)
        self._press(self.energy)

    def _press(self, energy: float | None = None) -> None:
        """As `_weigh`, where only the contact has changed."""
        contact = self.contact
        self.energy = self._inner + contact.energy if energy is None else energy
        self.pushes = np.zeros_like(self._force)  # (3, N) N, contact forces on the nodes
        self.points.add(contact.force, self.pushes, contact.near)
        self._slope = self._force - self.pushes
        clear_nodes(self._slope, self._fixed)
        self.imbalance = float(np.linalg.norm(self._slope))  # N, of the unbalanced forces
        moving = self.pushes.copy()
        clear_nodes(moving, self._fixed)
        self.load = float(np.linalg.norm(moving))  # N, of the contact forces

    def _energy(self) -> float:
        """J, of tissue and contact at the displacement; finds the tissue's forces there too."""
        self._inner = self.tissue.energy_and_forces(self.displacement, self._force)
        if self.overstress is not None:
            self._inner += self.overstress.energy(self.displacement)
        return self._inner + self.contact.energy

    def rehearse(self) -> None:
        """Take a step with a factor and with damping, as only some frames do."""
        self._factors, self.may_factor, self._damping = True, True, _DAMPING
        self.step(2)
        self.rest()

    @property
    def unbalanced(self) -> NDArray[np.float64]:
        """(3, N) N, the energy's slope."""
        return self._slope

    def step(
        self, iterations: int, goal: float = 0.0, start: NDArray[np.float64] | None = None
    ) -> bool:
        """One Newton step with a line search.

        Args:
            iterations: the most of the conjugate gradients.
            goal: N, imbalance below which there is no need to go.
            start: (3, N) m, a guess of the step.

        Returns:
            Whether a step was taken; if not, the next will be shorter.
        """
        change, curved = self._minimise_model(iterations, goal, start)
        length = self._search(change)
        self._carried = 0.0
        if length > 0.0:
            self._held = self.contact.push
        if length < 1.0:
            self.patience = _LEAST_PATIENCE
        elif self.used >= iterations:
            self.patience *= 2
            if self.patience > self._most_patience and self.may_factor:
                self._factors = True
        if length < 1.0 or curved:
            self._damping = min(max(4 * self._damping, _DAMPING), _MOST_DAMPING)
        else:
            self._damping = self._damping / 4 if self._damping > _LEAST_DAMPING else 0.0
        return length > 0.0

    @property
    def is_stuck(self) -> bool:
        """Whether even the shortest steps lead no further."""
        return self._damping >= _MOST_DAMPING

    def _minimise_model(
        self, iterations: int, goal: float, start: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float64], bool]:
        """The step (3, N) m, and whether the tangent was found to be indefinite."""
        self.used = 0  # iterations
        contact, points, tangent = self.contact, self.points, self._tangent
        tangent.linearise(self.displacement.astype(self._dtype))
        blocks = tangent.diagonal_blocks()
        damping = self._damping
        if damping > 0.0:
            blocks += self._dtype(damping) * self._rest_blocks
        if (overstress := self.overstress) is not None:
            blocks += self._dtype(overstress.stiffness) * self._rest_blocks
        # Just hit, points are pushed far more than they will be.
        turned, turn = contact.turns(self._places, np.minimum(contact.push, self._held))
        bend = points.nodes[turned], points.weights[turned], -turn

        def elastic(change: NDArray, image: NDArray) -> None:
            """The tangent without springs, of which there are more or fewer as nodes touch."""
            tangent.tangent_product(change, image)
            if damping > 0.0:
                add_blocks(self._rest_blocks, damping, change, image)
            if overstress is not None:
                overstress.add_product(change, image)
            if len(turned):
                add_turns(*bend, change, image)

        step: NDArray[np.float64] = np.zeros_like(self.displacement)
        image: NDArray[np.float64] = np.zeros_like(step)  # of the step
        if start is not None:
            step = start.copy()
            scale = float(np.abs(step).max()) or 1.0
            product = np.empty(step.shape, self._dtype)
            elastic((step / scale).astype(self._dtype), product)
            image = scale * product.astype(np.float64)
            self.used += 1
            none = np.zeros_like(contact.normal)
            length = self._best_length(none, step, image, np.zeros_like(image))
            step *= length
            image *= length
        enough: float | None = None
        segment = _SEGMENT
        while True:
            moved = points.moved(step, contact.near)
            left = -self._force - image
            points.add(contact.force_after(moved), left, contact.near)
            clear_nodes(left, self._fixed)
            size = float(np.linalg.norm(left))
            if enough is None:
                begun = max(size, self.imbalance * (start is None))
                # Just hit, the forces are far more than they will be.
                begun = min(begun, self._carried or begun)
                enough = max(_FORCING * begun, _AIM * goal)
            if size <= enough or self.used >= iterations:
                return step, False
            active, directions, stiffness = contact.springs_after(moved)
            springs = points.nodes[active], points.weights[active], directions, stiffness

            def pressed(change: NDArray, image: NDArray, springs: tuple = springs) -> None:
                """The springs' forces, added."""
                add_springs(*springs, change, image)

            solved = conjugate_gradients(
                elastic,
                self._preconditioner(blocks, *points.lumped(active, directions, stiffness)),
                (left / size).astype(self._dtype),
                min(iterations - self.used, segment),
                enough / size,
                pressed,
            )
            self.used += solved.iterations
            segment *= 2
            change = size * solved.solution.astype(np.float64)
            bent = size * solved.image.astype(np.float64)
            length = self._best_length(moved, change, bent, image)
            change, bent = length * change, length * bent
            step += change
            image += bent
            if solved.curved:
                return (step if step.any() else size * solved.direction.astype(np.float64)), True

    def _best_length(
        self,
        moved: NDArray[np.float64],
        change: NDArray[np.float64],
        bent: NDArray[np.float64],
        image: NDArray[np.float64],
    ) -> float:
        """How much of a change (3, N) m lowers the model's energy most, the points having moved by
        (P, 3) m; the tangent's products with the change and before it are (3, N) N.
        """
        pull = -float(np.vdot(change, self._force + image))
        curvature = float(np.vdot(change, bent))
        contact = self.contact
        along = self.points.moved(change, contact.near)
        return contact.length_along(moved, along, pull, curvature)

    def _preconditioner(
        self,
        blocks: NDArray[np.floating],
        nodes: NDArray[np.integer],
        directions: NDArray[np.float64],
        stiffness: NDArray[np.float64],
    ) -> Preconditioner:
        """Of the tangent, whose blocks are (6, N) N/m, with springs: a factor where one is needed,
        there is time to make it, and it can be made.
        """
        if self._factors and self.may_factor:
            if self._factored is None:
                self._factored = FactoredStiffness(self._model)
            if self._factored.prepare(self.displacement, nodes, directions, stiffness):
                return self._factored
        self._two_level.prepare(blocks, nodes, directions, stiffness)
        return self._two_level

    def _search(self, change: NDArray[np.float64]) -> float:
        """Move by the largest fraction of the change that lowers the energy; returns it."""
        start, energy, imbalance = self.displacement, self.energy, self.imbalance
        bound = energy + _ROUNDING * abs(energy)
        length = 1.0
        for _ in range(_BACKTRACKS):
            self._move(start + length * change)
            tried = self._energy()
            if tried <= bound:
                self._weigh(tried)
                if tried < energy - _ROUNDING * abs(energy) or self.imbalance < imbalance:
                    return length
            length /= 2
        self.put(start)
        return 0.0


_STRIDE = 3e-3
"""Way of a probe in tissue that is gone at once, m."""

_MOST = 8
"""Strides in a frame; a longer way is a leap."""


def strides(last: Pose | None, pose: Pose, depth: float, arm: float) -> list[Pose]:
    """Poses on the way to one: from the last, or after a leap from before the tissue.

    Args:
        last: where the probe was, if it touched the tissue.
        pose: where it is now.
        depth: m, of that in the tissue as it is.
        arm: m, from the probe's origin to the outermost of it, which turns move farthest.
    """
    if last is not None:
        turned = 2 * math.acos(min(1.0, abs(float(last.orientation @ pose.orientation))))
        way = math.dist(last.position, pose.position) + arm * turned
        count = math.ceil(way / _STRIDE)
        if count <= _MOST:
            return [interpolate(last, pose, k / count) for k in range(1, count)]
    count = min(math.ceil(depth / _STRIDE), _MOST)
    backs = [(1 - k / count) * depth for k in range(1, count)]
    return [Pose(pose.position - x * pose.rotation[:, 2], pose.orientation) for x in backs]
