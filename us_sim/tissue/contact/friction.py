"""A probe with friction on an elastic surface of known compliance: Coulomb's law, or sticking.

A touched node stays where it is on the probe as long as its force is in the friction cone; beyond,
it slips, and the force along the surface is the coefficient times the push, against the slip. Each
node in turn gets the force that satisfies this while the others hold theirs, until nothing changes
any more (nonlinear Gauss-Seidel: M. Jean, The non-smooth contact dynamics method, Comput. Methods
Appl. Mech. Eng. 177, 1999); around it, as without friction, the probe's tangent planes are renewed.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.friction import FrictionalContact
>>> springs = np.eye(3) / 50.0  # m/N, one node
>>> contact = FrictionalContact(Sphere(0.03), np.zeros((1, 3)), 0.02, springs, 0.5)
>>> contact.press(Pose(position=[0.0, 0.0, 0.01])), contact.press(Pose([0.001, 0.0, 0.01]))
(True, True)
>>> contact.forces.round(3)  # dragged along by 1 mm
array([[0.05, 0.  , 0.5 ]])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.tissue.contact.compliant_contact import (
    CLOSED,
    SKIRT,
    CompliantContact,
    gaps,
    gather,
    yielded,
)

_ROUNDS = 30
_SWEEPS = 100

_STILL = 2e-11
"""Sweeps go on until no node moves by more, m."""

_LOCAL = 10
"""Steps towards a node's force when its turn comes."""

_TURN = 1e-8
"""A normal that turns by less (rad) has converged."""


class FrictionalContact(CompliantContact):
    """Which nodes the probe pushes, drags and lets slip.

    Args:
        collider, rest, spacing, compliance: as for `CompliantContact`.
        friction: coefficient; infinite for a probe to which tissue sticks until it is pulled.
    """

    def __init__(
        self,
        collider: Collider,
        rest: NDArray[np.float64],
        spacing: float,
        compliance: NDArray[np.float64],
        friction: float,
    ) -> None:
        super().__init__(collider, rest, spacing, compliance)
        self._friction = friction
        self._anchor = np.zeros((len(rest), 3))  # (S, 3), m, frame probe, where touched nodes were
        self._anchored = np.zeros(len(rest), dtype=bool)
        self._next = (self._anchor, self._anchored)

    def clear(self) -> None:
        """Touch nothing, and remember nothing."""
        super().clear()
        self._anchored = np.zeros(len(self._rest), dtype=bool)
        self._next = (self._anchor, self._anchored)

    def press(self, pose: Pose) -> bool:
        """As `CompliantContact.press`; nodes that stick go where the probe went."""
        self._anchor, self._anchored = self._next
        return super().press(pose)

    def _solve(self, pose: Pose) -> bool:
        near = np.flatnonzero(self.near)
        rest = self._rest[near]
        displacement = self.displacement[near]
        forces = self.forces[near]
        place = pose.apply(self._anchor[near]) - rest
        anchored = self._anchored[near]
        converged, slips, unsettled = _coulomb(
            self._box,
            self._forward,
            pose.rotation,
            np.array(pose.position),
            self._rest,
            self._spacing,
            gather(self._compliance, near),
            near,
            self._friction,
            anchored,
            place,
            displacement,
            forces,
        )
        self.sliding_force = unsettled
        self.forces[:] = 0.0
        self.forces[near] = forces
        self.displacement[near] = displacement
        pushed = forces.any(axis=1)
        place[slips] = displacement[slips]
        anchor, held = self._anchor.copy(), np.zeros(len(self._rest), dtype=bool)
        anchor[near] = pose.inverse().apply(rest + place)
        held[near[pushed]] = True
        self._next = (anchor, held)
        return bool(converged)


@njit(cache=True, nogil=True, error_model="numpy")
def _coulomb(
    box,
    forward,
    rotation,
    origin,
    rest,
    spacing,
    block,
    near,
    friction,
    anchored,
    place,
    displacement,
    forces,
):
    """Revises displacement and forces (k, 3) of the nodes ``near``, and anchors those that join at
    place (k, 3).

    Returns whether it converged, which nodes slip, and the norm of the last change of the forces.
    """
    k = len(near)
    inverse = np.empty((k, 3, 3))
    for m in range(k):
        own = np.linalg.inv(block[3 * m : 3 * m + 3, 3 * m : 3 * m + 3].copy())
        for axis in range(3):
            for other in range(3):
                inverse[m, axis, other] = own[axis, other]
    gap, normal, last = np.empty(k), np.empty((k, 3)), np.zeros((k, 3))
    skirt, slips = np.zeros(k), np.zeros(k, np.bool_)
    offset, goal = np.empty(k), np.empty((k, 3))
    converged, unsettled = False, 0.0
    for iteration in range(_ROUNDS):
        load = 0.0
        for m in range(k):
            pushed = forces[m, 0] != 0.0 or forces[m, 1] != 0.0 or forces[m, 2] != 0.0
            skirt[m] = SKIRT * spacing if pushed else skirt[m]
            load += pushed
        gaps(box, forward, rotation, origin, rest, near, displacement, skirt, gap, normal)
        turn, fits = 0.0, iteration > 0
        for m in range(k):
            pushed = forces[m, 0] != 0.0 or forces[m, 1] != 0.0 or forces[m, 2] != 0.0
            if pushed:
                fits &= abs(gap[m]) <= CLOSED
                for axis in range(3):
                    turn = max(turn, abs(normal[m, axis] - last[m, axis]))
            else:
                fits &= gap[m] >= -CLOSED
        converged = fits and turn <= _TURN and unsettled == 0.0
        if converged:
            break
        for m in range(k):
            for axis in range(3):
                last[m, axis] = normal[m, axis]
            if not anchored[m] and gap[m] < 0.0:
                anchored[m] = True
                for axis in range(3):
                    place[m, axis] = displacement[m, axis] - gap[m] * normal[m, axis]
            offset[m] = gap[m]
            beyond = gap[m]
            for axis in range(3):
                offset[m] -= normal[m, axis] * displacement[m, axis]
                beyond += normal[m, axis] * (place[m, axis] - displacement[m, axis])
            for axis in range(3):
                goal[m, axis] = place[m, axis] - beyond * normal[m, axis]
        unsettled = _sweep(block, inverse, offset, normal, goal, anchored, friction, forces, slips)
        active = np.zeros(k, np.bool_)
        for m in range(k):
            active[m] = forces[m, 0] != 0.0 or forces[m, 1] != 0.0 or forces[m, 2] != 0.0
        yielded(block, active, forces, displacement)
    return converged, slips, unsettled


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _sweep(block, inverse, offset, normal, goal, anchored, friction, forces, slips):
    """Gauss-Seidel on forces (k, 3); returns 0, or the norm of the last change if it went on."""
    k = len(offset)
    flat = forces.reshape(-1)
    alone, force, along = np.empty(3), np.empty(3), np.empty(3)
    change = 0.0
    for _ in range(_SWEEPS):
        moved, change = 0.0, 0.0
        for m in range(k):
            own = block[3 * m : 3 * m + 3, 3 * m : 3 * m + 3]
            opened = offset[m]
            for axis in range(3):
                row = block[3 * m + axis]
                value = 0.0
                for j in range(3 * k):
                    value += row[j] * flat[j]
                for other in range(3):
                    value -= own[axis, other] * forces[m, other]
                alone[axis] = value
                opened += normal[m, axis] * value
            force[:] = 0.0
            slips[m] = False
            if np.isfinite(opened) and opened < 0.0:
                if anchored[m]:
                    for axis in range(3):
                        for other in range(3):
                            force[axis] += inverse[m, axis, other] * (goal[m, other] - alone[other])
                push, beside = _parts(force, normal[m], along)
                if push <= 0.0 or beside > friction * push:
                    slips[m] = True
                    for axis in range(3):
                        force[axis] = forces[m, axis]
                    _project(own, alone, offset[m], normal[m], goal[m], friction, along, force)
            for axis in range(3):
                step = force[axis] - forces[m, axis]
                change += step * step
                moved = max(moved, abs(step) * own[axis, axis])
                forces[m, axis] = force[axis]
        if moved <= _STILL:
            return 0.0
    return np.sqrt(change)


@njit(cache=True, nogil=True, error_model="numpy")
def _parts(vector, normal, along):
    """The component along the normal, and the length of the tangent part, put into along (3,)."""
    part = vector[0] * normal[0] + vector[1] * normal[1] + vector[2] * normal[2]
    for axis in range(3):
        along[axis] = vector[axis] - part * normal[axis]
    return part, np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
def _project(own, alone, offset, normal, goal, friction, along, force):
    """Revises force (3,) by steps against gap and slip, cut back to the friction cone."""
    place, slip = np.empty(3), np.empty(3)
    across = 0.0
    stiff = 0.0
    for axis in range(3):
        across = max(across, own[axis, axis])
        for other in range(3):
            stiff += normal[axis] * own[axis, other] * normal[other]
    coefficient = friction if np.isfinite(friction) else 0.0
    for _ in range(_LOCAL):
        gap = offset
        for axis in range(3):
            place[axis] = alone[axis] - goal[axis]
            for other in range(3):
                place[axis] += own[axis, other] * force[other]
            gap += normal[axis] * (place[axis] + goal[axis])
        _parts(place, normal, slip)
        push, _ = _parts(force, normal, along)
        push = max(push - gap / stiff, 0.0)
        along -= slip / across
        beside = np.sqrt(along[0] ** 2 + along[1] ** 2 + along[2] ** 2)
        if beside > coefficient * push:
            along *= coefficient * push / beside
        change = 0.0
        for axis in range(3):
            value = push * normal[axis] + along[axis]
            change = max(change, abs(value - force[axis]))
            force[axis] = value
        if change * across < 0.1 * _STILL:
            return
