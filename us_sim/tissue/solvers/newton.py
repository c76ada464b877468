"""Mechanics of ``fem_nonlinear``: Newton's method for the energy of tissue and contact together.

The energy is that of `neo_hookean` and `penalty_contact`. A step minimises its quadratic model, in
which points come to touch and are let go as the displacement says, by conjugate gradients with the
exact tangent; then a line search takes as much of it as lowers the energy itself. Where the tangent
is indefinite or a step had to be cut, the model is made stiffer (K. Levenberg, A method for the
solution of certain non-linear problems in least squares, Q. Appl. Math. 2, 1944), and softer again
as steps succeed. The iterates may be inside out, which the energy allows for; whoever shows them
has to wait.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.model import TissueModel
>>> newton = Newton(TissueModel.make_block(nodes=(5, 5, 5)))
>>> newton.set_pose(Pose(position=[0.0, 0.0, 0.005]))
>>> residual_norm, energy = newton.residual_norm, newton.energy
>>> all(newton.step(20) for _ in range(6))
True
>>> newton.residual_norm < 1e-3 * residual_norm, newton.energy < energy
(True, True)
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.surface_points import add_springs, add_turns, make_surface_contact
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.linear_algebra.sparse_factors import FactoredStiffness
from us_sim.tissue.linear_algebra.two_level import (
    CoarseGrid,
    Preconditioner,
    Product,
    TwoLevel,
    add_blocks,
    clear_nodes,
    largest_local_eigenvalue,
    solve_conjugate_gradients,
)
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.tuning import TUNING


class Newton:
    """A state of the tissue, the forces in it, and steps towards their balance.

    Args:
        model: of the tissue and the probe.
    """

    energy: float  # J, of tissue and contact
    contact_forces: NDArray[np.float64]  # (3, N) N, on the nodes
    contact_norm: float  # N, of those on free nodes
    residual: NDArray[np.float64]  # (3, N) N, slope of the energy; zero at fixed nodes
    residual_norm: float  # N
    iterations: int  # of the last step

    def __init__(self, model: TissueModel) -> None:
        self._model = model
        self._factored: FactoredStiffness | None = None  # made where it is first needed
        #: Whether a factor takes no longer than a frame.
        self.is_small = int((~model.fixed).sum()) <= TUNING.small_tissue
        #: Whether a step may take the time to factor the stiffness.
        self.may_factor = False
        mesh, modulus = model.mesh, model.materials.young_modulus
        bulk = 1 / (1 - 2 * model.materials.poisson_ratio.max())  # lambda + mu over mu
        single = modulus.max() <= TUNING.single_contrast * modulus.min()
        single &= bulk <= TUNING.single_bulk
        self._dtype: type[np.floating] = np.float32 if single else np.float64
        self.tissue = NeoHookean(mesh, model.materials, np.float64)
        # Conjugate gradients only correct; what they correct is in double precision.
        self._tangent = NeoHookean(mesh, model.materials, self._dtype)
        self._fixed = np.flatnonzero(model.fixed)
        grid = CoarseGrid(mesh, model.fixed, self.tissue.tangent_product, self._dtype)
        rest = self.tissue.diagonal_blocks()
        self._rest_blocks: NDArray[np.floating] = rest.astype(self._dtype)
        most = largest_local_eigenvalue(rest, self.tissue.tangent_product, self._fixed)
        self._two_level = TwoLevel(grid, self._fixed, TUNING.local_weight / most)
        self.points, self.contact = make_surface_contact(model)
        self.displacement = np.zeros((3, len(mesh.nodes)))  # m
        self._load = np.ascontiguousarray(model.load.T)  # (3, N) N, besides that of the probe
        self.load_norm = _norm(self._load)  # N
        self.rest = self.displacement  # (3, N) m, under that load alone
        self._points_at_rest = self.points.rest  # (P, 3) m
        self._tissue_forces = np.zeros_like(self.displacement)  # N, slope of the tissue's energy
        self.reset()
        if self.load_norm > 0.0:
            self._find_rest()

    def _find_rest(self) -> None:
        """Let the tissue sag under its own load, which is its rest from then on.

        Raises:
            SolverError: no balance is found.
        """
        self.may_factor = True
        for _ in range(TUNING.rest_steps):
            if self.residual_norm <= TUNING.rest_residual * self.load_norm or self.has_stagnated:
                break
            self.step(self.iteration_limit)
        self.may_factor = False
        left = self.residual_norm / self.load_norm
        if not left <= 1e3 * TUNING.rest_residual:
            raise SolverError(
                f"the tissue finds no balance under its own load, of which {left:.1g} is left: its "
                f"gravity or forces are too much for its moduli"
            )
        self.rest = self.displacement
        self._points_at_rest = self.points.compute_positions(self.rest)
        self.reset()

    def reset(self) -> None:
        """Put the tissue to rest: under no load but its own, and touched nowhere."""
        self.displacement = self.rest.copy()
        self._positions = self._points_at_rest  # of the points near the probe
        self.contact.clear()
        # N, contact forces before the pose was set, until a step is taken from there
        self._carried_norm = 0.0
        # (P,) N, normal forces of the last state that was not just hit
        self._carried_force = self.contact.normal_force
        self._damping = 0.0
        self._conditioner: Preconditioner | None = None  # of the last step
        self.iteration_limit = TUNING.first_iteration_limit  # of the next step
        self._needs_factor = False  # whether a step since has needed more iterations than allowed
        self._drop_factor()
        self._assemble()

    def _drop_factor(self) -> None:
        """Precondition without a factor until a step needs one, as at every new pose.

        A small tissue goes on with factors once a step has needed one: they cost it little.
        """
        self._needs_factor &= self.is_small
        self._has_factor = False  # whether one was made at this pose that still serves
        self._factors_left = TUNING.most_factors  # that may be made at this pose

    def measure_depth_at_rest(self, pose: Pose) -> float:
        """Return how deep (m) a probe would be in the tissue at rest."""
        return self.contact.measure_depth(pose, self._points_at_rest)

    def measure_depth(self, pose: Pose) -> float:
        """Return how deep (m) a probe would be in the tissue as it is."""
        return self.contact.measure_depth(pose, self.points.compute_positions(self.displacement))

    def set_pose(self, pose: Pose) -> None:
        """Put the probe at a pose; nothing moves."""
        self._carried_force = self.contact.normal_force
        self._carried_norm = self.contact_norm
        self._positions = self.points.compute_positions(self.displacement)
        self.contact.set_pose(pose, self._positions)
        # Damping by nodes' own blocks would halve the first step of the smoothest modes.
        self._damping = 0.0
        self.iteration_limit = TUNING.first_iteration_limit
        self._drop_factor()
        self._assemble_contact()

    def update_contact(self) -> float:
        """Update the direction of contact forces at the end of a frame.

        Returns:
            m, by how much tissue may move for it; infinite where that is not known.
        """
        change = self.contact.update_relief()
        self._positions = self.points.compute_positions(self.displacement)
        if self.contact.drop_planes(self._positions):
            change = np.inf
        self._assemble_contact()
        return change

    def set_displacement(self, displacement: NDArray[np.float64]) -> None:
        """Put the tissue elsewhere: (3, N) m."""
        self._move(displacement)
        self._assemble()

    def _move(self, displacement: NDArray[np.float64]) -> None:
        self.displacement = displacement
        self._positions = self.points.compute_positions(displacement, self.contact.near)
        self.contact.update_gaps(self._positions)

    def _assemble(self, energy: float | None = None) -> None:
        """Update energy, unless `_evaluate` has just returned it, and residual."""
        self.energy = self._evaluate() if energy is None else energy
        self._assemble_contact(self.energy)

    def _assemble_contact(self, energy: float | None = None) -> None:
        """Update as `_assemble`, where only the contact has changed."""
        contact = self.contact
        self.energy = self._tissue_energy + contact.energy if energy is None else energy
        self.contact_forces = np.zeros_like(self._tissue_forces)
        self.points.add_to_nodes(contact.force, self.contact_forces, contact.near)
        self.residual = self._tissue_forces - self.contact_forces
        clear_nodes(self.residual, self._fixed)
        self.residual_norm = _norm(self.residual)
        self._displacement_error: float | None = None
        free = self.contact_forces.copy()
        clear_nodes(free, self._fixed)
        self.contact_norm = _norm(free)

    def _evaluate(self) -> float:
        """Return the energy (J) at the displacement; update the tissue's forces, less its load."""
        self._tissue_energy = self.tissue.compute_energy_and_forces(
            self.displacement, self._tissue_forces
        )
        if self.load_norm > 0.0:
            self._tissue_energy -= _dot(self._load, self.displacement)
            self._tissue_forces -= self._load
        return self._tissue_energy + self.contact.energy

    def compile_kernels(self) -> None:
        """Take a step with a factor, with damping and with points deep in the probe.

        Only some frames do so.
        """
        self.set_pose(Pose(np.array([0.0, 0.0, 2 * self.contact.probe.deep])))
        self._needs_factor, self.may_factor, self._damping = True, True, TUNING.damping
        self.step(2)
        self.reset()

    def step(
        self, iterations: int, goal: float = 0.0, start: NDArray[np.float64] | None = None
    ) -> bool:
        """Take one Newton step with a line search.

        Args:
            iterations: limit of the conjugate gradients.
            goal: N, residual norm below which there is no need to go.
            start: (3, N) m, a guess of the step.

        Returns:
            Whether a step was taken; if not, the next will be shorter.
        """
        self.update_relief()
        change, indefinite = self._minimise_model(iterations, goal, start)
        length = self._search(change)
        self._carried_norm = 0.0
        if length > 0.0:
            self._carried_force = self.contact.normal_force
        if length < 1.0:
            self.iteration_limit = TUNING.first_iteration_limit
        elif self.iterations >= iterations:
            self.iteration_limit *= 2
            most = TUNING.small_iteration_limit if self.is_small else TUNING.iteration_limit
            if self.iteration_limit > most and self.may_factor:
                self._needs_factor = True
            self._has_factor = False
        if length < 1.0 or indefinite:
            raised = max(4 * self._damping, TUNING.damping)
            self._damping = min(raised, TUNING.most_damping)
        else:
            self._damping = self._damping / 4 if self._damping > TUNING.damping else 0.0
        return length > 0.0

    def update_relief(self) -> None:
        """Measure the relief of gaps anew, on which the energy depends; nothing moves."""
        if self.contact.update_relief() > 0.0:
            self._assemble_contact()

    @property
    def applied_norm(self) -> float:
        """N, norm of the tissue's own load and the contact's forces."""
        return math.hypot(self.contact_norm, self.load_norm)

    @property
    def has_stagnated(self) -> bool:
        """True if even the shortest steps lead no further."""
        return self._damping >= TUNING.most_damping

    @property
    def displacement_error(self) -> float:
        """Estimated distance to balance, over the displacement's norm; infinite before a step.

        It is that by which the last step's preconditioner would move the tissue. Smooth errors need
        hardly any force, so that the residual says little of them.
        """
        if self._displacement_error is None:
            self._displacement_error = np.inf
            size = _norm(self.displacement)
            if self._conditioner is not None and size > 0.0:
                change = np.empty(self.residual.shape, self._dtype)
                scale = self.residual_norm or 1.0
                self._conditioner.apply((self.residual / scale).astype(self._dtype), change)
                self._displacement_error = scale * _norm(change) / size
        return self._displacement_error

    def _minimise_model(
        self, iterations: int, goal: float, start: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float64], bool]:
        """Find the step (3, N) m; return also whether the tangent was found to be indefinite."""
        self.iterations = 0
        contact, points, tangent = self.contact, self.points, self._tangent
        tangent.linearise(self.displacement.astype(self._dtype))
        blocks = tangent.diagonal_blocks()
        damping = self._damping
        if damping > 0.0:
            blocks += self._dtype(damping) * self._rest_blocks
        # Just hit, points are pushed far more than they will be.
        force = np.minimum(contact.normal_force, self._carried_force)
        turned, turn = contact.geometric_stiffness(self._positions, force)
        geometric = points.nodes[turned], points.weights[turned], -turn

        def tangent_product(change: NDArray, image: NDArray) -> None:
            """Multiply by the tangent without springs, whose number changes as points touch."""
            tangent.tangent_product(change, image)
            if damping > 0.0:
                add_blocks(self._rest_blocks, damping, change, image)
            if len(turned):
                add_turns(*geometric, change, image)

        step: NDArray[np.float64] = np.zeros_like(self.displacement)
        image: NDArray[np.float64] = np.zeros_like(step)  # of the step
        if start is not None:
            step, image = self._take_guess(start, tangent_product)
        tolerance: float | None = None  # N
        interval = TUNING.contact_interval
        while True:
            moved = points.interpolate_field(step, contact.near)
            residual = -self._tissue_forces - image
            points.add_to_nodes(contact.force_after(moved), residual, contact.near)
            clear_nodes(residual, self._fixed)
            norm = _norm(residual)
            if tolerance is None:
                first_norm = max(norm, self.residual_norm * (start is None))
                # Just hit, the forces are far more than they will be.
                first_norm = min(first_norm, self._carried_norm or first_norm)
                late = start is None and damping == 0.0 and not self._carried_norm
                term = TUNING.late_forcing_term if late else TUNING.forcing_term
                tolerance = max(term * first_norm, TUNING.goal_fraction * goal)
            if norm <= tolerance or self.iterations >= iterations:
                return step, False
            active, directions, stiffness = contact.springs_after(moved)
            springs = points.nodes[active], points.weights[active], directions, stiffness
            lumped = points.lump_springs(active, directions, stiffness)
            self._conditioner = self._preconditioner(blocks, *lumped)
            solved = solve_conjugate_gradients(
                tangent_product,
                self._conditioner,
                (residual / norm).astype(self._dtype),
                min(iterations - self.iterations, interval),
                tolerance / norm,
                partial(add_springs, *springs),
            )
            self.iterations += solved.iterations
            interval *= 2
            change = norm * solved.solution.astype(np.float64)
            change_image = norm * solved.image.astype(np.float64)
            length = self._best_length(moved, change, change_image, image)
            change, change_image = length * change, length * change_image
            step += change
            image += change_image
            if solved.curved:
                return (step if step.any() else norm * solved.direction.astype(np.float64)), True

    def _take_guess(
        self, start: NDArray[np.float64], product: Product
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the best fraction of a guess of the step (3, N) m, and its product (3, N) N.

        ``product`` writes the tangent times its first argument into the second.
        """
        scale = float(np.abs(start).max()) or 1.0
        scaled = np.empty(start.shape, self._dtype)
        product((start / scale).astype(self._dtype), scaled)
        image = scale * scaled.astype(np.float64)
        self.iterations += 1
        none = np.zeros_like(self.contact.normal)
        length = self._best_length(none, start, image, np.zeros_like(image))
        return length * start, length * image

    def _best_length(
        self,
        moved: NDArray[np.float64],
        change: NDArray[np.float64],
        change_image: NDArray[np.float64],
        image: NDArray[np.float64],
    ) -> float:
        """Return the fraction of a change (3, N) m that lowers the model's energy most.

        The points have moved by ``moved`` (P, 3) m; the tangent's products with the change and with
        what came before it are (3, N) N.
        """
        pull = -_dot(change, self._tissue_forces + image)
        curvature = _dot(change, change_image)
        along = self.points.interpolate_field(change, self.contact.near)
        return self.contact.find_best_length(moved, along, pull, curvature)

    def _preconditioner(
        self,
        blocks: NDArray[np.floating],
        nodes: NDArray[np.integer],
        directions: NDArray[np.float64],
        stiffness: NDArray[np.float64],
    ) -> Preconditioner:
        """Choose the preconditioner of the tangent, whose blocks are (6, N) N/m, with springs.

        A factor where one is needed, there is time for it, and it can be made. One serves all steps
        at a pose until a step with it needs more iterations than allowed. It is made anew for every
        set of springs only in a small tissue.
        """
        if self._needs_factor and self.may_factor:
            if self._factored is None:
                self._factored = FactoredStiffness(self._model)
            if self.is_small or (not self._has_factor and self._factors_left > 0):
                self._factors_left -= 1
                self._has_factor = self._factored.factor_at(
                    self.displacement, nodes, directions, stiffness
                )
            if self._has_factor:
                return self._factored
        self._two_level.set_matrix(blocks, nodes, directions, stiffness)
        return self._two_level

    def _search(self, change: NDArray[np.float64]) -> float:
        """Search along a change (3, N) m by backtracking; return the fraction taken."""
        start, energy, residual_norm = self.displacement, self.energy, self.residual_norm
        rounding = TUNING.energy_rounding * abs(energy)
        length = 1.0
        for _ in range(TUNING.backtracks):
            self._move(start + length * change)
            tried = self._evaluate()
            if tried <= energy + rounding:
                self._assemble(tried)
                if tried < energy - rounding or self.residual_norm < residual_norm:
                    return length
            length /= 2
        self.set_displacement(start)
        return 0.0


def _dot(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Return the product of (3, N) arrays.

    BLAS, by `np.vdot`, takes two threads beyond 10,000 numbers, and while other programs run these
    wait for each other: frames took eight times as long.
    """
    return float(np.einsum("ij,ij->", first, second))


def _norm(vector: NDArray[np.floating]) -> float:
    return math.sqrt(_dot(vector, vector))
