"""The skin as a membrane of springs, anchored to its shape at rest (the paper, section V).

Edges of the surface are springs; each vertex is a particle that a spring of zero length and a
damper tie to its rest position. Particles move by symplectic Euler (the paper, equations 3 to 5).

The probe's repulsion is taken to its rigid limit: particles inside the collider are put on its
surface, with which they move on. Then the middles of the triangles' parts are, so that no edge of
the probe comes through between particles; a triangle's particles follow by weight and mass, as an
impulse would send them (M. Mueller et al., Position based dynamics, J. Vis. Commun. Image
Represent. 18, 2007). They are pushed one after the other, which leaves them within a few hundredths
of their distance from where the energy is least.

An unstretched spring does not resist a displacement across it, and skin of such springs has a
crease where contact ends. Skin in the body is under tension, which smooths it: the springs are
prestrained here, and the anchors carry the tension at rest, so that nothing pulls on a surface at
rest. With ``prestrain=0`` the springs are the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.collider_distance import (
    measure_box_distance,
    measure_distances,
    rotate_vector,
    rotate_vector_back,
)
from us_sim.geometry.pose import Pose, is_same_pose
from us_sim.geometry.triangles import TriangleParts, choose_part_size, compute_vertex_normals
from us_sim.kernels import njit
from us_sim.skin.settings import MembraneSettings
from us_sim.skin.surface import TriangleSurface

# Fraction of its natural length below which a spring's force falls to zero with its length. The
# force of a spring that turns over would otherwise jump, and no step would be stable.
SHORTEST = 0.5


@njit(cache=True, nogil=True, error_model="numpy")
def spring_forces(force, x, rest, edges, natural_length, rest_tension, stiffness, anchor):
    """Fill force (N, 3) N with that of the edge springs and the anchors."""
    for i in range(len(x)):
        for a in range(3):
            force[i, a] = anchor * (rest[i, a] - x[i, a])
    if stiffness == 0.0:
        return
    for e in range(len(edges)):
        i = edges[e, 0]
        j = edges[e, 1]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        stretch = 1.0 - natural_length[e] / max(length, SHORTEST * natural_length[e])
        fx = stiffness * (stretch * dx - rest_tension[e, 0])
        fy = stiffness * (stretch * dy - rest_tension[e, 1])
        fz = stiffness * (stretch * dz - rest_tension[e, 2])
        force[i, 0] += fx
        force[i, 1] += fy
        force[i, 2] += fz
        force[j, 0] -= fx
        force[j, 1] -= fy
        force[j, 2] -= fz


class PartArrays(NamedTuple):
    """Parts of a surface's triangles, as the kernel takes them."""

    triangles: NDArray[np.uint32]  # (T, 3) particles
    first: NDArray[np.integer]  # (T + 1,) where a triangle's parts begin
    weights: NDArray[np.float64]  # (P, 3) of the particles in each part's middle


@njit(cache=True, nogil=True, error_model="numpy")
def push_out(x, way, mass, parts, longest, box, start, end, fraction):  # noqa: PLR0913
    """Put particles and parts inside the collider on its surface; return how many.

    The probe is at ``fraction`` of the path from ``start`` to ``end``. ``way`` (N, 3) m is set to
    how far each particle of ``mass`` (N,) kg was pushed. No side of a triangle is longer than
    ``longest`` (m). The collider is convex, so it reaches no triangle with a corner that is farther
    off than that.
    """
    r, p = _place(start, end, fraction)
    # The whole collider lies within this distance of its middle.
    middle = box[2] + box[3]
    reach = box[3] + np.sqrt(box[0] ** 2 + box[1] ** 2 + box[2] ** 2)
    away = np.empty(len(x))  # m, of each particle from the collider, or less
    contacts = 0
    for i in range(len(x)):
        way[i] = 0.0
        a, b, c = x[i, 0] - p[0], x[i, 1] - p[1], x[i, 2] - p[2]
        square = (a + r[0, 2] * middle) ** 2
        square += (b + r[1, 2] * middle) ** 2 + (c + r[2, 2] * middle) ** 2
        if square > reach**2:
            away[i] = np.sqrt(square) - reach
            continue
        away[i] = _push_particle(x, way, i, box, r, p)
        if away[i] < 0.0:
            away[i] = 0.0
            contacts += 1
    triangles, first, weights = parts
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        if max(away[i], away[j], away[k]) > longest:
            continue
        if _is_parallel(way[i], way[j]) and _is_parallel(way[i], way[k]):
            continue  # on one flat side
        gaps = away[i], away[j], away[k]
        for m in range(first[t], first[t + 1]):
            contacts += _push_part(x, way, (i, j, k), gaps, mass, weights[m], box, r, p)
    for i in range(len(x)):
        if way[i, 0] != 0.0 or way[i, 1] != 0.0 or way[i, 2] != 0.0:
            _push_particle(x, way, i, box, r, p)
    return contacts


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _is_parallel(a, b):
    """Return whether two vectors (3,) point the same way, and neither is zero."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    squares = (a[0] ** 2 + a[1] ** 2 + a[2] ** 2) * (b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    return squares > 0.0 and dot > 0.0 and dot * dot >= (1.0 - 1e-12) * squares


@njit(cache=True, nogil=True, error_model="numpy")
def _place(start, end, fraction):
    """Return the rotation (3, 3) and place (3,) at a fraction of the way between two placements."""
    cosine = start[3] * end[3] + start[4] * end[4] + start[5] * end[5] + start[6] * end[6]
    sign = 1.0 if cosine >= 0.0 else -1.0
    qx = start[3] + fraction * (sign * end[3] - start[3])
    qy = start[4] + fraction * (sign * end[4] - start[4])
    qz = start[5] + fraction * (sign * end[5] - start[5])
    qw = start[6] + fraction * (sign * end[6] - start[6])
    scale = 2.0 / (qx * qx + qy * qy + qz * qz + qw * qw)
    r = np.empty((3, 3))
    r[0, 0] = 1.0 - scale * (qy * qy + qz * qz)
    r[0, 1] = scale * (qx * qy - qw * qz)
    r[0, 2] = scale * (qx * qz + qw * qy)
    r[1, 0] = scale * (qx * qy + qw * qz)
    r[1, 1] = 1.0 - scale * (qx * qx + qz * qz)
    r[1, 2] = scale * (qy * qz - qw * qx)
    r[2, 0] = scale * (qx * qz - qw * qy)
    r[2, 1] = scale * (qy * qz + qw * qx)
    r[2, 2] = 1.0 - scale * (qx * qx + qy * qy)
    return r, start[:3] + fraction * (end[:3] - start[:3])


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _distance(box, r, a, b, c):
    """Return the distance (m) and the collider's normal at (a, b, c) m from the probe's origin."""
    x, y, z = rotate_vector_back(r, a, b, c)
    distance, nx, ny, nz = measure_box_distance(box, x, y, z)
    nx, ny, nz = rotate_vector(r, nx, ny, nz)
    return distance, nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy")
def _push_particle(x, way, i, box, r, p):
    """Put a particle on the collider's surface if it is inside; return its distance before."""
    distance, nx, ny, nz = _distance(box, r, x[i, 0] - p[0], x[i, 1] - p[1], x[i, 2] - p[2])
    if distance < 0.0:
        for axis, n in enumerate((nx, ny, nz)):
            x[i, axis] -= distance * n
            way[i, axis] -= distance * n
    return distance


@njit(cache=True, nogil=True, error_model="numpy")
def _push_part(x, way, corners, gaps, mass, weight, box, r, p):  # noqa: PLR0913
    """Put a point of a triangle on the collider's surface if it is inside; return how many.

    The point has weights (3,) at three particles, which are ``gaps`` (3,) m from the collider.
    """
    a, b, c, light = -p[0], -p[1], -p[2], 0.0
    for q in range(3):
        w, i = weight[q], corners[q]
        light += w * w / mass[i]
        a += w * x[i, 0]
        b += w * x[i, 1]
        c += w * x[i, 2]
    for q in range(3):
        i = corners[q]
        square_way = (a + p[0] - x[i, 0]) ** 2 + (b + p[1] - x[i, 1]) ** 2
        square_way += (c + p[2] - x[i, 2]) ** 2
        if gaps[q] ** 2 > square_way:
            return 0  # no place so near a particle is inside
    distance, nx, ny, nz = _distance(box, r, a, b, c)
    if distance >= 0.0:
        return 0
    for q in range(3):
        length = -distance * weight[q] / (mass[corners[q]] * light)
        for axis, n in enumerate((nx, ny, nz)):
            x[corners[q], axis] += length * n
            way[corners[q], axis] += length * n
    return 1


# Fraction of the linear system's longest stable step that is used. Near 1, folded skin with
# hardly any damping was seen to gain energy from frame to frame.
_SAFETY = 0.7
_SETTLED = 1e-7  # A frame that moves no vertex farther than this leaves the membrane settled, m
# A settled membrane without contact that is this close to its rest shape is put there, m.
_AT_REST = 1e-6
# A probe that moves farther than this between frames was lifted and set down elsewhere, m.
_JUMP = 0.03
_MOST_STEPS = 400  # in a frame
_STRETCHED = 1.5  # Length that an edge may reach in a frame, over the longest at its beginning


@dataclass(frozen=True, eq=False)
class SkinDeformation:
    """The skin under the probe."""

    vertices: NDArray[np.float64]  # (N, 3), m, frame patient
    normals: NDArray[np.float64]  # (N, 3), unit, out of the body
    residual: float  # unbalanced force over the force that the anchors bear; 0 at rest
    action: str  # remark on a failed frame, or on masses or steps changed for stability, else ''
    has_failed: bool = False  # the forces were not finite, so the latest shape was kept


class SkinMembrane:
    """A surface of anchored particles and springs that a probe presses.

    Args:
        surface: at rest.
        collider: the probe's shape.
        settings: see `MembraneSettings`. Where the mass of a vertex is raised, or a long movement
            of the probe takes more steps, every deformation's ``action`` says so.

    Examples:
        >>> import numpy as np
        >>> from us_sim.geometry.collider import Sphere
        >>> from us_sim.geometry.pose import Pose
        >>> from us_sim.skin.surface import plane_surface
        >>> skin = SkinMembrane(plane_surface((0.1, 0.1), 0.005), Sphere(0.03))
        >>> pressed = skin.deform(Pose([0, 0, 0.005]))
        >>> f"{pressed.vertices[:, 2].max():.3f} m"
        '0.005 m'
    """

    def __init__(
        self, surface: TriangleSurface, collider: Collider, settings: MembraneSettings | None = None
    ) -> None:
        self.settings = settings = settings or MembraneSettings()
        self.surface = surface
        self._collider = collider
        # Unsigned, since numba tests a signed index for counting from the end.
        self._edges = edges = surface.edges.astype(np.uint32)
        at_rest = surface.vertices[edges[:, 1]] - surface.vertices[edges[:, 0]]
        length = np.sqrt((at_rest**2).sum(axis=1))
        self._natural_length = (1.0 - settings.prestrain) * length
        self._rest_tension = np.ascontiguousarray(at_rest * settings.prestrain)

        triangles = surface.triangles
        corners = surface.vertices[triangles]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        rounding = float(collider.offset_box[3])
        parts = TriangleParts(
            sides.max(axis=1), choose_part_size(rounding, float(np.median(sides)))
        )
        self._parts = PartArrays(triangles.astype(np.uint32), parts.first, parts.weights)

        valence = np.bincount(surface.edges.ravel(), minlength=len(surface.vertices))
        # Gershgorin's bound: no mode is stiffer than twice a particle's springs plus its anchor.
        stiffest = 2.0 * settings.stiffness * valence + settings.anchor_stiffness
        density_mass = settings.density * surface.vertex_areas
        lightest = stiffest * (settings.time_step / (2.0 * _SAFETY)) ** 2
        self.mass: NDArray[np.float64] = np.maximum(density_mass, lightest)  # (N,), kg
        self.step_limit = float(2.0 * np.sqrt(np.min(density_mass / stiffest)))
        """s, the longest stable step with the masses that follow from ``density``."""
        self._decay = 2.0 * settings.damping * np.sqrt(settings.anchor_stiffness / self.mass)
        self._scaling = ""
        if (self.mass > density_mass).any():
            with np.errstate(divide="ignore"):
                most = float(np.max(self.mass / density_mass))
            self._scaling = (
                f"masses raised up to {most:.3g} times, as a step of {settings.time_step:g} s is "
                f"stable only up to {self.step_limit:.2g} s without"
            )
        self._at_rest = SkinDeformation(
            surface.vertices, compute_vertex_normals(surface.vertices, surface.triangles), 0.0, ""
        )
        self.reset()

    def with_settings(self, settings: MembraneSettings) -> SkinMembrane:
        """Return a membrane of the same surface and probe with other settings, at rest."""
        return SkinMembrane(self.surface, self._collider, settings)

    def reset(self) -> None:
        """Return to the rest shape, without a probe."""
        self._vertices = self.surface.vertices
        self._velocity = np.zeros_like(self._vertices)
        self._pose: Pose | None = None
        self._settled = True
        self._latest = self._at_rest

    def warm_up(self) -> None:
        """Compile every kernel, or load it from numba's cache; the membrane stays as it is."""
        small = SkinMembrane(
            TriangleSurface(np.eye(3), np.array([[0, 1, 2]], dtype=np.int32)), self._collider
        )
        small.deform(Pose())

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(N, 3) m/s, of the vertices at the end of the latest frame."""
        return self._velocity.copy()

    def deform(self, pose: Pose | None) -> SkinDeformation:
        """Advance the skin by a frame, with the probe moved to ``pose``; None takes it away.

        With an unmoved probe and a settled membrane the latest result is returned unchanged.
        """
        if self._settled and is_same_pose(pose, self._pose):
            return self._latest
        start, steps, note = self._approach(pose)
        settings = self.settings
        vertices, velocity = self._vertices.copy(), self._velocity.copy()
        residual, moved, contacts = _relax(
            *(vertices, velocity, self.surface.vertices, self._edges, self._natural_length),
            *(self._rest_tension, settings.stiffness, settings.anchor_stiffness, self.mass),
            *(self._decay, settings.time_step, steps, self._parts, self._collider.offset_box),
            *(_placement(start), _placement(pose), pose is not None),
        )
        finite = np.isfinite(vertices).all() and np.isfinite(velocity).all()
        if not (finite and math.isfinite(residual)):
            self._velocity[:] = 0.0
            return SkinDeformation(
                self._latest.vertices,
                self._latest.normals,
                self._latest.residual,
                "the springs' forces are not finite: kept the latest shape and stopped its motion",
                has_failed=True,
            )
        self._settled = moved < _SETTLED
        if self._settled:
            velocity[:] = 0.0
            if not contacts and np.abs(vertices - self.surface.vertices).max() < _AT_REST:
                vertices[:] = self.surface.vertices
                residual = 0.0
        vertices.flags.writeable = False
        self._vertices, self._velocity, self._pose = vertices, velocity, pose
        if self._settled and not contacts and residual == 0.0:
            self._latest = self._at_rest
            return self._latest
        self._latest = SkinDeformation(
            vertices,
            compute_vertex_normals(vertices, self.surface.triangles),
            float(residual),
            "; ".join(part for part in (self._scaling, note) if part),
        )
        return self._latest

    def _approach(self, pose: Pose | None) -> tuple[Pose | None, int, str]:
        """Return the pose that the probe comes from, its number of steps, and a remark on them.

        A probe that appears inside the skin would push particles out on its far side. So it comes
        along its axis from where it touches nothing, in steps that are short against its body.
        """
        if pose is None:
            return None, self.settings.steps, ""
        start = self._pose
        if start is None or np.linalg.norm(pose.position - start.position) > _JUMP:
            start = self._lift(pose)
        box = self._collider.offset_box
        turn = 2.0 * math.acos(min(1.0, abs(float(pose.orientation @ start.orientation))))
        reach = math.hypot(box[0], box[1], 2 * box[2]) + 2 * box[3]
        travel = float(np.linalg.norm(pose.position - start.position)) + turn * reach
        wanted = math.ceil(travel / (0.25 * (box[2] + box[3])))
        steps = min(max(self.settings.steps, wanted), _MOST_STEPS)
        if steps == self.settings.steps:
            return start, steps, ""
        return start, steps, f"{steps} steps for a probe that moved {1e3 * travel:.3g} mm"

    def _lift(self, pose: Pose) -> Pose:
        axis = pose.rotation[:, 2]
        for lift in np.arange(0.0, 0.1, 2.5e-3):
            lifted = Pose(pose.position - lift * axis, pose.orientation)
            distance, _ = measure_distances(self._collider, lifted, self._vertices)
            if distance.min() >= 0.0:
                break
        return lifted


def _placement(pose: Pose | None) -> NDArray[np.float64]:
    if pose is None:
        return np.array([0.0, 0, 0, 0, 0, 0, 1])
    return np.concatenate([pose.position, pose.orientation])


@njit(cache=True, nogil=True, error_model="numpy")
def _relax(  # noqa: PLR0913
    x, v, rest, edges, natural_length, rest_tension, stiffness, anchor, mass, decay,
    time_step, steps, parts, box, start, end, pressed,
):  # fmt: skip
    """Move the membrane on in time, and the probe from ``start`` to ``end``.

    Positions x (N, 3) m and velocities v (N, 3) m/s are changed. ``rest_tension`` (E, 3) m is that
    of a spring at rest over its stiffness, ``decay`` (N,) 1/s, ``parts`` `PartArrays`, ``box`` the
    collider's ``offset_box``; ``start`` and ``end`` are (7,) placements of the probe, if there is
    one (``pressed``).

    Returns:
        The residual, the farthest that a vertex moved (m), and the number in contact.
    """
    n = len(x)
    before = x.copy()
    force, last, way = np.empty((n, 3)), np.empty((n, 3)), np.zeros((n, 3))
    longest = _STRETCHED * _longest(x, edges)
    contacts = 0
    awake = np.any(x != rest) or np.any(v != 0.0)
    for step in range(1, steps + 1):
        last[:] = x
        if awake:
            spring_forces(force, x, rest, edges, natural_length, rest_tension, stiffness, anchor)
            _step(x, v, force, mass, decay, time_step)
        if pressed:
            contacts = push_out(x, way, mass, parts, longest, box, start, end, step / steps)
            awake = awake or contacts > 0
            for i in range(n if contacts else 0):
                if way[i, 0] != 0.0 or way[i, 1] != 0.0 or way[i, 2] != 0.0:
                    _follow(x[i], last[i], time_step, v[i])
    if not awake:
        return 0.0, 0.0, contacts
    spring_forces(force, x, rest, edges, natural_length, rest_tension, stiffness, anchor)
    squares = (x - before) ** 2
    moved = np.sqrt((squares[:, 0] + squares[:, 1] + squares[:, 2]).max())
    return _residual(x, rest, way, force, anchor), moved, contacts


@njit(cache=True, nogil=True, error_model="numpy")
def _step(x, v, force, mass, decay, time_step):
    """Take a step of symplectic Euler under force (N, 3) N."""
    for i in range(len(x)):
        gain = time_step / mass[i]
        # The dampers act on the velocity at the end of the step: they cost no stability.
        kept = 1.0 / (1.0 + time_step * decay[i])
        for a in range(3):
            v[i, a] = kept * (v[i, a] + gain * force[i, a])
            x[i, a] += time_step * v[i, a]


@njit(cache=True, nogil=True, error_model="numpy")
def _residual(x, rest, way, force, anchor):
    """Return the unbalanced force over the one that the anchors bear; 0 where they bear none."""
    unbalanced = 0.0
    borne = 0.0
    for i in range(len(x)):
        # The contact force acts along the way a particle was pushed, and balances a force back.
        length = way[i, 0] ** 2 + way[i, 1] ** 2 + way[i, 2] ** 2
        along = way[i, 0] * force[i, 0] + way[i, 1] * force[i, 1] + way[i, 2] * force[i, 2]
        held = min(along, 0.0) / length if length > 0.0 else 0.0
        for a in range(3):
            unbalanced += (force[i, a] - held * way[i, a]) ** 2
            borne += (anchor * (x[i, a] - rest[i, a])) ** 2
    return np.sqrt(unbalanced / borne) if borne != 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(now, last, time_step, velocity):
    """Give a pushed particle the velocity (3,) of its way, but no higher speed than before.

    Thus contact never adds kinetic energy, and a particle at rest against the probe has none.
    """
    before = after = 0.0
    for a in range(3):
        before += velocity[a] ** 2
        velocity[a] = (now[a] - last[a]) / time_step
        after += velocity[a] ** 2
    if after > before:
        scale = np.sqrt(before / after)
        for a in range(3):
            velocity[a] *= scale


@njit(cache=True, nogil=True, error_model="numpy")
def _longest(x, edges):
    """Return the length (m) of the longest edge."""
    square = 0.0
    for e in range(len(edges)):
        i, j = edges[e]
        away = (x[i, 0] - x[j, 0]) ** 2 + (x[i, 1] - x[j, 1]) ** 2 + (x[i, 2] - x[j, 2]) ** 2
        square = max(square, away)
    return np.sqrt(square)
