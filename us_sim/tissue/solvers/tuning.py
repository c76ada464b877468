"""Every tuned constant of ``fem_nonlinear``: Newton's method, its load steps, time and recovery.

"Iterations" are those of the conjugate gradients, in which nearly all of a frame's time goes. Where
a line tells of half and twice the value, both were tried on 264 poses of a hand at 0.08 m/s with
leaps, under a rounded box and under a sphere on 1,040 nodes (Poisson's ratio 0.49, no time limit).
That took 21,519 iterations in 2,402 Newton steps, and every frame ended at a residual of at most
0.003. "No change" is one of less than 2 percent. Damping and `late_forcing_term` were found later,
on five motions of `evaluation.hand.hand_motion`, brisk and violent, on 2,000 and 5,040 nodes.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """The constants, each with its unit, its meaning, and the cost of other values."""

    # Newton's method (`us_sim.tissue.solvers.newton`)
    first_iteration_limit: int = 12
    """Iterations of the first step at a pose. It doubles while steps need not be cut. Solved
    further, the step after a large change overshoots and is cut by the line search. Half: 4 % fewer
    iterations, 3 % more steps; twice: 6 % more iterations, and a frame that ended at 0.06."""
    iteration_limit: int = 100
    """Greatest iteration limit of a step: beyond, a factor of the stiffness takes less time. No
    change with half or twice, since only a tissue with stiff parts comes there."""
    small_iteration_limit: int = 45
    """The same of a small tissue."""
    most_factors: int = 2
    """Factors of the stiffness that may be made for one pose, except in a small tissue: one, and
    another where points have come to touch since."""
    small_tissue: int = 500
    """Free nodes up to which factoring the stiffness takes no longer than a frame."""
    forcing_term: float = 0.2
    """Residual norm of a step's linear model, over the first, at which conjugate gradients end.
    Half: 11 % more iterations, 14 % fewer steps; twice: 11 % fewer and 36 % more. The time is the
    same, since the next step has a new tangent."""
    late_forcing_term: float = 0.07
    """The same of undamped steps after a frame's first, near the solution, where Newton's method
    converges quadratically. 0.2: 13 % more steps, 11 % fewer iterations; 0.02: 6 % fewer steps,
    12 % more iterations."""
    goal_fraction: float = 0.3
    """The same over the residual norm that a frame is to reach. Half: no change; twice: 5 % fewer
    iterations, and a mean residual that is 23 % higher."""
    contact_interval: int = 12
    """Iterations after which the linear model finds anew which points touch; then twice as many.
    Half: 9 % more iterations; twice: a frame that ended at 0.045."""
    backtracks: int = 8
    """Step lengths of a line search, each half of the one before. Half: 2 % more iterations; twice:
    no change."""
    energy_rounding: float = 1e-12
    """Fraction of the energy by which rounding may seem to raise it."""
    damping: float = 0.003
    """Levenberg's least damping, after a step that was cut, over the nodes' own stiffness at rest;
    four times as much after each further one, and a quarter after each that was not. A smooth mode
    is far softer than the nodes: at 8,192 nodes 0.01 halves its step. No change with 0.01."""
    most_damping: float = 1e3
    """Damping beyond which no step leads any further: the method has stagnated."""
    local_weight: float = 12.0
    """Weight of the local preconditioner, over the largest eigenvalue of the locally preconditioned
    stiffness at rest. 1 to 25 were tried."""
    single_contrast: float = 1e4
    """Ratio of Young's moduli beyond which conjugate gradients need double precision: rounding in
    single hides the softer forces."""
    single_bulk: float = 1e3
    """Bulk over shear modulus beyond which they need it, since rounding hides the shear's."""

    # Rest under gravity and forces at nodes (`us_sim.tissue.solvers.newton`)
    rest_steps: int = 200
    """Steps at most to it. A beam that hangs by its own length takes 20."""
    rest_residual: float = 1e-8
    """Residual norm, over the load's, with which it is found; a thousand times that will do."""

    # Load steps and prediction (`us_sim.tissue.solvers.fem_nonlinear`)
    load_step: float = 3e-3
    """m, longest way of a probe in tissue that is gone at once. Tissue that is hit or swept aside
    at once may end elsewhere than if the probe had moved there. Half: 4 % more iterations; twice:
    no change of what a frame takes."""
    most_load_steps: int = 8
    """Load steps of a frame; a longer way is a leap, after which the probe comes from above. No
    change with half or twice."""
    load_step_tolerance: float = 0.2
    """Residual with which a load step ends. No change with half or twice."""
    load_step_newton_steps: int = 5
    """Newton's steps of a load step. No change with half or twice."""
    load_step_time: float = 0.5
    """Part of a frame's time after which no step of a load step is begun."""
    load_step_iterations: float = 0.6
    """Part of a frame's iterations after which none is begun. Half: no change; twice, so that load
    steps leave nothing for the pose itself: a frame that ended at 0.18."""
    predicted_gap: float = 0.1
    """Gap up to which a node may come to touch within a frame, over the tissue's smallest side. No
    change with half or twice."""

    # Time and iterations of a frame (`us_sim.tissue.solvers.frame_budget`)
    newton_step_cost: int = 8
    """Cost of a Newton step besides its iterations, in iterations. Half: no change; twice: 1 %
    of the frames ended above 0.01, at up to 0.034."""
    overtime: float = 1.25
    """Time, over a live frame's own, that one out of balance may take; those after it make up
    for that. With 3, and nothing made up for, 3 % of the poses were lost."""
    overtime_tolerance: float = 0.01
    """Residual and error up to which a frame is in balance for that. Of 1,920 frames of brisk hands
    with 16 seeds on 2,000 nodes, at 0.07 ms an iteration, 4.3 % had a node over 1 mm from the
    converged answer, for up to 117 ms, and nodes came 17.9 ms after their pose at p99; with 0.1
    5.3 %, 200 ms and 16.2 ms; without any limit 3.3 % and 150 ms, since tissue that snaps may be
    in balance in two ways, and a residual of 0.003 does not tell that it will."""
    least_iterations: int = 4
    """Iterations for which a further step is begun; with fewer its fixed cost is most of it."""
    rest_frames: int = 30
    """Frames of a probe at rest after which one that is not in balance may take longer than its
    time, to be solved."""
    rest_factor: int = 2
    """Iterations, over those of other frames, that a frame of a probe at rest may take."""
    restart_factor: int = 6
    """The same of a frame that begins anew from rest."""

    # Recovery, and when tissue is settled
    inverted_frames: int = 10
    """Frames in a row that may end inside out before the tissue is begun anew from rest. None where
    time is short and the probe moves on: what is shown would stay behind ever farther."""
    settled_motion: float = 10.0
    """Motion that settled tissue may still see when contact is updated, over the spacing of the
    nodes that the probe can touch, for a tolerance of 1."""
    reported_depth: float = 0.5
    """Depth of the probe in the tissue, over that spacing, from which on it is reported."""


TUNING = Tuning()
