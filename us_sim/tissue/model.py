"""The tissue that solvers deform, and the deformation that they find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Flag, auto
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.geometry.collider import Collider, Sphere
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import (
    LabelFractions,
    TissueMaterials,
    average_over_labels,
)
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes

# Faces of a box by name, as (axis, at its maximum). In frame patient z points into the tissue, so
# that the skin is the face of smallest z.
FACES = {
    "top": ((2, False),),
    "bottom": ((2, True),),
    "left": ((0, False),),
    "right": ((0, True),),
    "front": ((1, False),),
    "back": ((1, True),),
    "sides": ((0, False), (0, True), (1, False), (1, True)),
}


# Distance from a bounding box's face, over the box's size, up to which nodes count as on the
# face; for meshes that are no box.
_MARGIN = 0.05
# Fixed nodes, also as a part of all, below which there is a remark that they are few.
_FEW, _FEW_PART = 10, 0.01
# The cosine to -z below which a probe that comes along +z would only graze the surface.
_GRAZING = 0.1


def describe_held_nodes(name: str, nodes: NDArray[np.integer], mesh: TetrahedralMesh) -> str | None:
    """Say how many nodes a name in a scene's ``fixed`` holds; None where nothing is to be said.

    It is said of a mesh from a file, which may touch its bounding box at single nodes, and where
    they are few.
    """
    count, of = len(nodes), len(mesh.nodes)
    said = f"fixed: `{name}` holds {count} of {of} nodes"
    if count < max(_FEW, _FEW_PART * of):
        return f"{said}, which is little; see tissue.fixed and tissue.mesh.margin"
    return None if mesh.planes is not None else said


def face_nodes(mesh: TetrahedralMesh, face: str, margin: float | None = None) -> NDArray[np.int32]:
    """Return (K,) nodes at a face of the mesh's bounding box, ascending.

    Of a box mesh, those in the plane of the face; of any other, those of its boundary that are
    near to it, since an organ touches its bounding box at single nodes.

    Args:
        mesh: of the tissue.
        face: a name from `FACES`; ``top`` is the skin, ``sides`` are the four that stand on it.
        margin: m, how near, for a mesh that is no box; by default a twentieth of its size along
            that axis.

    Raises:
        MeshError: there is no such face.
    """
    if face not in FACES:
        raise MeshError(f"a box has no face {face!r}: its faces are {', '.join(FACES)}")
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    rounding = 1e-9 * float((high - low).max())
    eligible = np.ones(len(mesh.nodes), dtype=bool)
    near = np.zeros(3)
    if mesh.planes is None:
        eligible[:] = False
        eligible[mesh.boundary] = True
        near[:] = _MARGIN * (high - low) if margin is None else margin
    chosen = np.zeros(len(mesh.nodes), dtype=bool)
    for axis, at_maximum in FACES[face]:
        plane = (high if at_maximum else low)[axis]
        chosen |= np.abs(mesh.nodes[:, axis] - plane) <= near[axis] + rounding
    return np.flatnonzero(chosen & eligible).astype(np.int32)


def facing_nodes(mesh: TetrahedralMesh) -> NDArray[np.int32]:
    """Return (K,) nodes of the boundary that look towards the probe, ascending.

    The probe comes along +z: their normal, of the adjacent triangles weighted by area, is less than
    84 degrees off -z.
    """
    a, b, c = (mesh.nodes[mesh.boundary[:, corner]] for corner in range(3))
    areas = np.cross(b - a, c - a)
    normals = np.zeros_like(mesh.nodes)
    for corner in range(3):
        np.add.at(normals, mesh.boundary[:, corner], areas)
    lengths = np.linalg.norm(normals, axis=1)
    return np.flatnonzero(-normals[:, 2] > _GRAZING * lengths).astype(np.int32)


def nodes_in_label(
    mesh: TetrahedralMesh, fractions: LabelFractions, label: int
) -> NDArray[np.int32]:
    """Return (K,) nodes whose tetrahedra are mostly filled by a label, such as bone, ascending."""
    filled = fractions.for_label(label)
    around = mesh.tetrahedra.ravel()
    volume = np.bincount(around, np.repeat(mesh.volumes, 4), len(mesh.nodes))
    inside = np.bincount(around, np.repeat(mesh.volumes * filled, 4), len(mesh.nodes))
    return np.flatnonzero(inside > 0.5 * volume).astype(np.int32)


class Intervention(Flag):
    """A solver's remedies in a frame that went wrong; `Deformation.actions` describe them."""

    NONE = 0
    FRAME_FAILED = auto()  # what came out was not finite or far away
    KEPT_STATE = auto()  # the last good state is returned in its place
    PUT_TO_REST = auto()  # the tissue is undeformed again
    SHOWED_UPRIGHT = auto()  # tissue is inside out, and its last upright state is returned
    RESTARTED = auto()  # the next frame begins from rest


@dataclass(frozen=True, eq=False)
class Deformation:
    """The deformed tissue, and its force on the probe.

    Examples:
        >>> from us_sim.geometry.pose import Pose
        >>> from us_sim.tissue.solvers.solver import create_solver
        >>> pressed = create_solver("fem", TissueModel.make_block()).deform(Pose([0.0, 0.0, 0.01]))
        >>> pressed.nodes.shape, pressed.is_balanced, bool(pressed.force[2] < 0)
        ((216, 3), True, True)
    """

    nodes: NDArray[np.float64]  # (N, 3), m, frame patient, in mesh order
    contact_nodes: NDArray[np.int32]  # (K,), nodes that the probe pushes
    force: NDArray[np.float64]  # (3,), N, of the tissue on the probe, frame probe
    torque: NDArray[np.float64]  # (3,), N m, on the probe about the origin of frame probe
    residual: float  # unbalanced force over contact force, of the solver's own equations
    actions: tuple[str, ...] = ()  # what the solver did to stay stable, in sentences
    inverted: int = 0  # tetrahedra inside out, as far as the solver counts them
    is_balanced: bool = True  # else force and torque are an unfinished frame's or an older pose's
    interventions: Intervention = Intervention.NONE  # `actions` as a code

    @property
    def action(self) -> str:
        """All actions in one line, empty when there are none."""
        return "; ".join(self.actions)


@dataclass(frozen=True, eq=False)
class TissueState:
    """State of a tissue, which solvers hand to each other."""

    displacement: NDArray[np.float64]  # (N, 3), m
    velocity: NDArray[np.float64]  # (N, 3), m/s

    @classmethod
    def at_rest(cls, count: int) -> TissueState:
        """Return the state of an undeformed, still tissue of ``count`` nodes."""
        return cls(np.zeros((count, 3)), np.zeros((count, 3)))


_SOFT = Material(young_modulus=10e3, poisson_ratio=0.45, density=1000.0)


def _no_load() -> NDArray[np.float64]:
    return np.zeros(3)


@dataclass(frozen=True, eq=False)
class TissueModel:
    """A tissue and the probe that can press it.

    A node that is both held and reachable stays where it is; the probe passes through it.

    Raises:
        MeshError: an array has the wrong shape, or names nodes that the mesh has not.

    Examples:
        >>> model = TissueModel.make_block()
        >>> len(model.mesh.nodes), len(model.contact_nodes)
        (216, 36)
        >>> f"{model.lumped_mass.sum():.3f} kg"
        '1.000 kg'
        >>> fat, muscle = Material(10e3), Material(15e3)
        >>> layers = [(0.02, fat), (0.03, muscle)]
        >>> layered = TissueModel.make_block(layers=layers, gravity=[0.0, 0.0, 9.81])
        >>> f"{np.ptp(layered.mesh.nodes[:, 2]):.2f} m, {layered.load.sum(axis=0)[2]:.3g} N"
        '0.05 m, 4.41 N'
    """

    mesh: TetrahedralMesh
    materials: TissueMaterials
    fixed: NDArray[np.bool_]  # (N,), held at rest
    collider: Collider
    contact_nodes: NDArray[np.int32]  # (C,), which the probe can touch
    gravity: NDArray[np.float64] = field(default_factory=_no_load)  # (3,), m/s2
    forces: NDArray[np.float64] = field(default_factory=_no_load)  # (N, 3), or the same on all, N

    @classmethod
    def make_block(
        cls,
        size: tuple[float, float, float] = (0.1, 0.1, 0.1),
        nodes: tuple[int, int, int] = (6, 6, 6),
        *,
        material: Material = _SOFT,
        layers: Sequence[tuple[float, Material]] = (),
        collider: Collider | None = None,
        held: Sequence[str] = ("bottom",),
        gravity: ArrayLike = (0.0, 0.0, 0.0),
    ) -> TissueModel:
        """Make a box of one material, or of layers, with its top around the origin.

        Args:
            size: m, along x, y and z.
            nodes: of its mesh, along x, y and z.
            material: soft tissue by default.
            layers: thickness (m) and material of each from the top on, in place of the height and
                the material; nodes lie where two of them meet.
            collider: a sphere of 30 mm radius by default.
            held: names of the faces that are fixed, as `face_nodes` takes them. The probe can
                touch the top.
            gravity: (3,) m/s2.

        Raises:
            MeshError: there are too few nodes for the layers.
        """
        layers = layers or [(size[2], material)]
        ends = np.cumsum([0.0, *(thickness for thickness, _ in layers)])
        if nodes[2] <= len(layers):
            raise MeshError(f"{len(layers)} layers need {len(layers) + 1} nodes along z or more")
        # Of the cells beyond one a layer, most go to the thickest.
        cells = np.ones(len(layers), dtype=int)
        for _ in range(nodes[2] - 1 - len(layers)):
            cells[np.argmax(np.diff(ends) / cells)] += 1
        planes = [
            uniform_planes(ends[k], ends[k + 1], count + 1)[k > 0 :]
            for k, count in enumerate(cells)
        ]
        mesh = box_mesh(
            uniform_planes(-size[0] / 2, size[0] / 2, nodes[0]),
            uniform_planes(-size[1] / 2, size[1] / 2, nodes[1]),
            np.concatenate(planes),
        )
        fixed = np.zeros(len(mesh.nodes), dtype=bool)
        for face in held:
            fixed[face_nodes(mesh, face)] = True
        depth = mesh.nodes[mesh.tetrahedra, 2].mean(axis=1)
        layer = np.searchsorted(ends[1:-1], depth).astype(np.uint8)
        number = np.arange(len(layers), dtype=np.uint8)
        fractions = LabelFractions(number, (layer[:, None] == number).astype(np.float64))
        materials = average_over_labels(fractions, dict(enumerate(m for _, m in layers)))
        return cls(
            mesh,
            materials,
            fixed,
            collider or Sphere(0.03),
            face_nodes(mesh, "top"),
            np.array(gravity, dtype=np.float64),
        )

    def __post_init__(self) -> None:
        count = len(self.mesh.nodes)
        if len(self.materials.young_modulus) != len(self.mesh.tetrahedra):
            raise MeshError(
                f"materials are given for {len(self.materials.young_modulus)} tetrahedra, but the "
                f"mesh has {len(self.mesh.tetrahedra)}"
            )
        fixed = np.array(self.fixed)
        if fixed.shape != (count,) or fixed.dtype != np.bool_:
            raise MeshError(
                f"fixed is {fixed.dtype} of shape {fixed.shape}: give {count} booleans, one a node"
            )
        contact = np.array(self.contact_nodes)
        if contact.ndim != 1 or not np.issubdtype(contact.dtype, np.integer):
            raise MeshError("contact_nodes must be a list of node indices")
        if len(contact) and (contact.min() < 0 or contact.max() >= count):
            raise MeshError(
                f"contact_nodes run from {contact.min()} to {contact.max()}, but the mesh has "
                f"nodes 0 to {count - 1}"
            )
        if len(np.unique(contact)) != len(contact):
            raise MeshError("contact_nodes names a node twice: list each node once")
        for name, shapes in (("gravity", [(3,)]), ("forces", [(3,), (count, 3)])):
            given = np.array(getattr(self, name), dtype=np.float64)
            if given.shape not in shapes or not np.isfinite(given).all():
                raise MeshError(f"{name} has the shape {given.shape}: give {shapes[-1]} numbers")
            object.__setattr__(self, name, given)
        object.__setattr__(self, "fixed", fixed)
        object.__setattr__(self, "contact_nodes", contact.astype(np.int32))

    @cached_property
    def movable_contact_nodes(self) -> NDArray[np.int32]:
        """Those contact nodes that are not fixed."""
        return self.contact_nodes[~self.fixed[self.contact_nodes]]

    @cached_property
    def contact_spacing(self) -> float:
        """m, median length of the mesh edges between contact nodes; 0 when there are none."""
        reachable = np.zeros(len(self.mesh.nodes), dtype=bool)
        reachable[self.contact_nodes] = True
        ends = self.mesh.nodes[self.mesh.edges[reachable[self.mesh.edges].all(axis=1)]]
        if len(ends) == 0:
            return 0.0
        return float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))

    @cached_property
    def load(self) -> NDArray[np.float64]:
        """(N, 3) N, what gravity and forces at nodes pull on each; nothing at fixed nodes."""
        load = self.lumped_mass[:, None] * self.gravity + self.forces
        load[self.fixed] = 0.0
        return load

    @cached_property
    def lumped_mass(self) -> NDArray[np.float64]:
        """(N,) kg, a quarter of each tetrahedron's mass at each of its nodes."""
        quarter = self.materials.density * self.mesh.volumes / 4
        mass = np.zeros(len(self.mesh.nodes))
        np.add.at(mass, self.mesh.tetrahedra, quarter[:, None])
        return mass
