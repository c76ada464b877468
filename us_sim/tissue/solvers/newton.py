"""Newton's method for the energy of tissue and contact together: every step lowers it.

The energy is that of `neo_hookean` and of `penalty_contact`, and where they are asked for those of
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
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.penalty_contact import PenaltyContact
from us_sim.tissue.contact.penalty_friction import PenaltyFriction
from us_sim.tissue.elasticity.linear_tetrahedra import shear_times_area
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.elasticity.overstress import Overstress, PronyBranch
from us_sim.tissue.linear_algebra.coarse_grid import CoarseGrid
from us_sim.tissue.linear_algebra.factored_stiffness import FactoredStiffness
from us_sim.tissue.linear_algebra.two_level import (
    Preconditioner,
    TwoLevel,
    apply_blocks,
    conjugate_gradients,
)
from us_sim.tissue.model import TissueModel

__all__ = ["Newton"]

_SINGLE_CONTRAST = 1e4
"""Ratio of Young's moduli beyond which rounding in single precision hides the softer forces."""

_SINGLE_BULK = 1e3
"""Bulk over shear modulus beyond which rounding in single precision hides the shear's forces."""

_FIRMNESS = 8.0
"""Stiffness of a contact spring, over the tissue's own at that node: the probe sinks in by a
thirtieth of what one node alone would give way. More makes the equations worse conditioned."""

_GREATEST_PUSH = 30.0
"""Greatest contact force of a node, over shear modulus times area there. It is less than what a
crushed tetrahedron resists, so that a probe cannot turn one inside out."""

_AUGMENTED = 0.3
"""Fraction of that up to which the probe does not sink in at all."""

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

_LOCAL_WEIGHT = 6.0
"""Weight of the local preconditioner, over the largest eigenvalue of the locally preconditioned
stiffness at rest; 1 to 6 were tried."""

_POWER = 20
"""Power iterations towards the largest eigenvalue of the locally preconditioned stiffness."""


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
        self._surface = model.movable_contact_nodes
        self._surface_rest = mesh.nodes[self._surface]
        self.overstress: Overstress | None = None
        if branch is not None:
            single = NeoHookean(mesh, model.materials, self._dtype)
            self.overstress = Overstress(branch, self.tissue, single)
        stiffened = self.overstress.stiffened if self.overstress else None
        product = stiffened or self.tissue.tangent_product
        grid = CoarseGrid(mesh, model.fixed, product, self._dtype)
        rest = self.tissue.diagonal_blocks()
        self._rest_blocks: NDArray[np.floating] = rest.astype(self._dtype)
        self._two_level = TwoLevel(grid, self._fixed, _LOCAL_WEIGHT / self._largest(rest))
        own = (rest[0] + rest[3] + rest[5])[self._surface] / 3
        strongest = _GREATEST_PUSH * shear_times_area(mesh, model.materials)[self._surface]
        law = (model.collider, model.contact_spacing, _FIRMNESS * own, strongest)
        self.contact = PenaltyFriction(*law, friction) if friction else PenaltyContact(*law)
        shape = (3, len(mesh.nodes))
        self.displacement = np.zeros(shape)  # m
        self._force = np.zeros(shape)  # N, the slope of the tissue's energy
        self.rest()

    def rest(self) -> None:
        """Put the tissue to rest: undeformed, and touched nowhere."""
        self.displacement = np.zeros_like(self.displacement)
        self.contact.clear()
        if self.overstress is not None:
            self.overstress.forget(self.displacement)
        self._damping = 0.0
        self.patience = _LEAST_PATIENCE  # iterations that the next step may take
        self._factors = False  # whether factors have been needed since
        self._weigh()

    @property
    def surface(self) -> NDArray[np.float64]:
        """(C, 3) m, where the nodes are that the probe can touch."""
        return self._surface_rest + self.displacement[:, self._surface].T

    def aim(self, pose: Pose) -> None:
        """Put the probe at a pose, and weigh the forces; nothing moves."""
        self.contact.aim(pose, self.surface)
        self._damping = 0.0
        self.patience = _LEAST_PATIENCE
        self._weigh()

    def lift(self) -> None:
        """Take the probe away, and weigh the forces; nothing moves."""
        self.contact.clear()
        self._damping = 0.0
        self._weigh()

    def relax(self) -> None:
        """Let the time from frame to frame pass; nothing moves."""
        if self.overstress is not None:
            self.overstress.relax(self.displacement)
            self._weigh()

    def augment(self) -> float:
        """Push the tissue out of the probe further; returns by how much at most, m."""
        change = self.contact.augment(_AUGMENTED)
        self._weigh()
        return change

    def follow(self) -> float:
        """As `augment`, and fix the planes of contact where the nodes have come to be."""
        change = self.contact.augment(_AUGMENTED)
        change = max(change, self.contact.follow(self.surface))
        self._weigh()
        return change

    def expect(self, push: NDArray[np.float64]) -> None:
        """Learn which pushes (C,) N on the surface are likely at the pose; nothing moves."""
        if self.contact.expect(push):
            self._weigh()

    def put(self, displacement: NDArray[np.float64]) -> None:
        """Put the tissue elsewhere: (3, N) m."""
        self.displacement = displacement
        self.contact.look(self.surface)
        self._weigh()

    def _weigh(self, energy: float | None = None) -> None:
        """The energy, unless it is known, and its slope at the displacement."""
        contact = self.contact
        self.tissue.forces(self.displacement, self._force)
        self.energy = self._energy() if energy is None else energy  # J
        if self.overstress is not None:
            self.overstress.add_forces(self.displacement, self._force)
        self._slope = self._force.copy()
        force = contact.force
        self._slope[:, self._surface] -= force.T
        self._slope[:, self._fixed] = 0.0
        self.imbalance = float(np.linalg.norm(self._slope))  # N, of the unbalanced forces
        self.load = float(np.linalg.norm(force))  # N, of the contact forces

    def _energy(self) -> float:
        """J, of tissue and contact at the displacement."""
        energy = self.tissue.energy(self.displacement) + self.contact.energy
        if self.overstress is not None:
            energy += self.overstress.energy(self.displacement)
        return energy

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
        contact, nodes, tangent = self.contact, self._surface, self._tangent
        tangent.linearise(self.displacement.astype(self._dtype))
        blocks = tangent.diagonal_blocks()
        damped = None
        if self._damping > 0.0:
            damped = self._dtype(self._damping) * self._rest_blocks
            blocks += damped
        if (overstress := self.overstress) is not None:
            blocks += self._dtype(overstress.stiffness) * self._rest_blocks
        pushed = np.flatnonzero(contact.push > 0.0)
        turn = np.zeros((0, 3, 3))
        if not contact.forward and len(pushed):
            turn = contact.push[pushed, None, None] * contact.curvature(self.surface, pushed)
        turned = nodes[pushed] if len(turn) else nodes[:0]

        def elastic(change: NDArray, image: NDArray) -> None:
            """The tangent without springs, of which there are more or fewer as nodes touch."""
            tangent.tangent_product(change, image)
            if damped is not None:
                image += apply_blocks(damped, change)
            if overstress is not None:
                overstress.add_product(change, image)
            if len(turned):
                image[:, turned] -= np.einsum("kij,jk->ik", turn, change[:, turned])

        step: NDArray[np.float64] = np.zeros_like(self.displacement)
        image: NDArray[np.float64] = np.zeros_like(step)  # of the step
        if start is not None:
            step = start.copy()
            scale = float(np.abs(step).max()) or 1.0
            product = np.empty(step.shape, self._dtype)
            elastic((step / scale).astype(self._dtype), product)
            image = scale * product.astype(np.float64)
            self.used += 1
        enough: float | None = None
        segment = _SEGMENT
        while True:
            moved = step[:, nodes].T
            left = -self._force - image
            left[:, nodes] += contact.force_after(moved).T
            left[:, self._fixed] = 0.0
            size = float(np.linalg.norm(left))
            if enough is None:
                enough = max(_FORCING * max(size, self.imbalance * (start is None)), _AIM * goal)
            if size <= enough or self.used >= iterations:
                return step, False
            active, directions, stiffness = contact.springs_after(moved)
            springs = nodes[active], directions, stiffness
            solved = conjugate_gradients(
                elastic,
                self._preconditioner(blocks, *springs),
                (left / size).astype(self._dtype),
                min(iterations - self.used, segment),
                enough / size,
            )
            self.used += solved.iterations
            segment *= 2
            change = size * solved.solution.astype(np.float64)
            bent = size * solved.image.astype(np.float64)
            if isinstance(contact, PenaltyFriction):
                pull = -float(np.vdot(change, self._force + image))
                length = contact.length_along(
                    moved, change[:, nodes].T, pull, float(np.vdot(change, bent))
                )
                change, bent = length * change, length * bent
            step += change
            image += bent
            if solved.curved:
                return (step if step.any() else size * solved.direction.astype(np.float64)), True

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
            self.displacement = start + length * change
            self.contact.look(self.surface)
            tried = self._energy()
            if tried <= bound:
                self._weigh(tried)
                if tried < energy - _ROUNDING * abs(energy) or self.imbalance < imbalance:
                    return length
            length /= 2
        self.put(start)
        return 0.0

    def _largest(self, blocks: NDArray[np.float64]) -> float:
        """The largest eigenvalue of the stiffness at rest, preconditioned by its blocks."""
        two_level = TwoLevel(None, self._fixed, 1.0)
        none = np.zeros(0)
        two_level.prepare(blocks, np.zeros(0, np.int64), np.zeros((0, 3)), none)
        vector = np.random.default_rng(0).standard_normal((3, blocks.shape[1]))
        image = np.empty_like(vector)
        largest = 0.0
        for _ in range(_POWER):
            vector[:, self._fixed] = 0.0
            largest = float(np.linalg.norm(vector))
            if largest == 0.0:
                return 1.0
            self.tissue.tangent_product(vector / largest, image)
            image[:, self._fixed] = 0.0
            two_level.apply(image, vector)
        return largest
