"""A tissue solver's result for a probe pose, and the state that solvers hand to each other.

>>> import numpy as np
>>> from us_sim.tissue.deformation import TissueState
>>> TissueState.at_rest(2).displacement
array([[0., 0., 0.],
       [0., 0., 0.]])
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Flag, auto

import numpy as np
from numpy.typing import NDArray


class Intervention(Flag):
    """What a solver did in a frame that went wrong; `Deformation.action` says it to a person."""

    NONE = 0
    FRAME_FAILED = auto()  # what came out was not finite or far away
    KEPT_STATE = auto()  # the last good state is returned in its place
    PUT_TO_REST = auto()  # the tissue is undeformed again
    SHOWED_UPRIGHT = auto()  # tissue is inside out, and its last upright state is returned
    RESTARTED = auto()  # the next frame begins from rest


@dataclass(frozen=True, eq=False)
class Deformation:
    """The deformed tissue and what it does to the probe."""

    nodes: NDArray[np.float64]  # (N, 3), m, frame patient, in mesh order
    contact_nodes: NDArray[np.int32]  # (K,), nodes that the probe pushes
    force: NDArray[np.float64]  # (3,), N, of the tissue on the probe, frame probe
    torque: NDArray[np.float64]  # (3,), N m, likewise, about the origin of frame probe
    residual: float  # unbalanced force over contact force, of the solver's own equations
    action: str = ""  # what the solver did to stay stable, in words; '' when nothing
    inverted: int = 0  # tetrahedra inside out, as far as the solver counts them
    interventions: Intervention = Intervention.NONE  # `action` as a code
    is_balanced: bool = True  # else force and torque are an unfinished frame's or an older pose's


@dataclass(frozen=True, eq=False)
class TissueState:
    """What a solver needs to go on from where another one is."""

    displacement: NDArray[np.float64]  # (N, 3), m
    velocity: NDArray[np.float64]  # (N, 3), m/s

    @classmethod
    def at_rest(cls, count: int) -> TissueState:
        """Undeformed and still, for ``count`` nodes."""
        return cls(np.zeros((count, 3)), np.zeros((count, 3)))
