"""Stiff and extreme cases for tissue solvers: small meshes, materials, supports and motions.

>>> from us_sim.evaluation.stability.cases import make_mesh, make_poses
>>> from us_sim.evaluation.stability.cases import sample_cases, sample_held_cases
>>> cases = sample_cases(64)
>>> len(cases), cases == sample_cases(64), len(make_mesh("box").nodes)
(64, True, 64)
>>> [case.case for case in sample_held_cases(3, seed=1)]
['held 1.0', 'held 1.1', 'held 1.2']
>>> [round(float(pose.position[2]), 3) for pose in make_poses("press", make_mesh("box"), 0.5)]
[0.008, 0.016, 0.024, 0.032, 0.04, 0.04, 0.04]
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay
from scipy.stats import qmc

from us_sim.geometry.collider import Capsule, Collider, RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import (
    TetrahedralMesh,
    box_mesh,
    signed_volumes,
    uniform_planes,
)
from us_sim.tissue.model import TissueModel, face_nodes

COLLIDERS: dict[str, Collider] = {
    "sphere": Sphere(0.03),
    "needle": Sphere(0.001),
    "boulder": Sphere(0.4),
    "capsule": Capsule(0.012, 0.04),
    "plate": RoundedBox(0.05, 0.02, 0.03, 0.002),
    "pebble": RoundedBox(0.06, 0.05, 0.05, 0.025),
}
"""Colliders by name, for a tissue 0.1 m wide; for others they are scaled."""

LAYOUTS = ("inclusion", "skin", "half", "scattered")  # parts of a mesh, stiffer by the contrast

MOTIONS = ("press", "jump", "through", "tremor", "slide", "tilt", "scribble", "flicker")
"""Motions of the probe, see `make_poses`."""


@dataclass(frozen=True)
class StabilityCase:
    """One tissue, its support, and the motion of the probe."""

    case: str
    young_modulus: float = 1e4  # Pa, of the softest tetrahedron
    contrast: float = 1.0  # of the stiffest to the softest modulus
    layout: str = "inclusion"  # stiff part, of `LAYOUTS`
    poisson_ratio: float = 0.45
    density: float = 1000.0  # kg/m3
    time_step: float = 0.01  # s, of methods that have one
    damping: float = 1.0  # times the time in which a wave crosses an edge, of these methods
    depth: float = 0.25  # of the tissue's thickness
    motion: str = "press"
    mesh: str = "box"
    support: str = "bottom"
    collider: str = "sphere"
    release: str = "removed"  # the probe is "removed" or "lifted"
    stabilisation: str = "mass_scaling"  # of explicit methods
    held: int = 0  # frames for which the probe stays at the end of its motion


def sample_cases(count: int) -> list[StabilityCase]:
    """Sample ``count`` (a power of two) cases evenly over all ranges, by a Sobol sequence.

    Modulus, contrast, density, time step and damping (but for an eighth without any) are even in
    the logarithm, Poisson's ratio in that of 0.5 - ratio.
    """
    points = qmc.Sobol(13, scramble=False).random_base2(round(math.log2(count)))
    return [_sample_case(number, point) for number, point in enumerate(points)]


def _sample_case(number: int, point: NDArray[np.float64]) -> StabilityCase:
    def choose_name(values: tuple[str, ...], fraction: float) -> str:
        return values[int(fraction * len(values))]

    contrast = 9.0 * point[1]  # decimal logarithm, as the stiffest modulus, 12
    damping = 8 * point[5] / 7 - 1 / 7
    return StabilityCase(
        case=f"sample {number}",
        young_modulus=float(10 ** ((12.0 - contrast) * point[0])),
        contrast=float(10**contrast),
        poisson_ratio=float(0.5 - 0.5 * 10 ** (math.log10(2e-4) * point[2])),
        density=float(10 ** (6 * point[3])),
        time_step=float(10 ** (7 * point[4] - 6)),
        damping=float(10 ** (6 * damping - 3)) if damping >= 0 else 0.0,
        depth=float(point[6]),
        motion=choose_name(MOTIONS, point[7]),
        mesh=choose_name(tuple(MESHES), point[8]),
        collider=choose_name(tuple(COLLIDERS), point[9]),
        layout=choose_name(LAYOUTS, point[10]),
        support=choose_name(("bottom", "bottom", "bottom", "walls", "three"), point[11]),
        release=choose_name(("removed", "lifted"), point[12] * 2 % 1),
        stabilisation=choose_name(("mass_scaling",) * 3 + ("substeps",), point[12]),
    )


def list_extreme_cases() -> list[StabilityCase]:
    """List cases with a name: one extreme at a time."""
    cases = [
        StabilityCase("soft as 1 Pa", young_modulus=1.0),
        StabilityCase("stiff as 1 TPa", young_modulus=1e12),
        StabilityCase("contrast 1e9, stiff skin", 1.0, 1e9, "skin", motion="jump"),
        StabilityCase("contrast 1e9, scattered", 1e3, 1e9, "scattered", motion="jump"),
        StabilityCase("compressible", poisson_ratio=0.0, depth=0.9),
        StabilityCase("auxetic", poisson_ratio=-0.9),
        StabilityCase("nearly incompressible", poisson_ratio=0.4999, depth=0.5),
        StabilityCase("nearly incompressible jump", poisson_ratio=0.4999, depth=0.9, motion="jump"),
        StabilityCase("beyond any tissue", poisson_ratio=0.4999999),
        StabilityCase("light as gas", density=1.0),
        StabilityCase("heavy as a star", density=1e6),
        StabilityCase("steps of 1 us", time_step=1e-6),
        StabilityCase("steps of 10 s", time_step=10.0),
        StabilityCase("undamped", damping=0.0),
        StabilityCase("undamped, steps of 10 s", damping=0.0, time_step=10.0),
        StabilityCase("damped 1000 times", damping=1e3),
        StabilityCase("damped 1000 times, steps of 10 s", damping=1e3, time_step=10.0),
        StabilityCase("sub-stepped", time_step=1e-4, damping=0.01, stabilisation="substeps"),
        StabilityCase("refuses sub-steps", time_step=10.0, stabilisation="substeps"),
        StabilityCase("whole thickness", depth=1.0),
        StabilityCase("whole thickness in a jump", depth=1.0, motion="jump"),
        StabilityCase("whole thickness of a slab", depth=1.0, mesh="slab", collider="plate"),
        StabilityCase("through the body", depth=1.0, motion="through"),
        StabilityCase("through a fine body", depth=1.0, motion="through", mesh="fine"),
        StabilityCase("tremor", motion="tremor"),
        StabilityCase("tremor at depth", motion="tremor", depth=0.8, poisson_ratio=0.499),
    ]
    for mesh in MESHES:
        cases.append(StabilityCase(f"{mesh} pressed", mesh=mesh))
        cases.append(StabilityCase(f"{mesh} jumped at", mesh=mesh, motion="jump", depth=0.6))
    for collider in COLLIDERS:
        cases.append(StabilityCase(f"{collider} scribbling", collider=collider, motion="scribble"))
    return cases


def make_model(case: StabilityCase) -> TissueModel:
    """Make the tissue of a case, with the same checks as any other."""
    mesh = make_mesh(case.mesh)
    count = len(mesh.tetrahedra)
    modulus = np.full(count, case.young_modulus)
    modulus[_find_stiff(mesh, case.layout)] *= case.contrast
    materials = TissueMaterials(
        modulus, np.full(count, case.poisson_ratio), np.full(count, case.density)
    )
    fixed = find_fixed_nodes(mesh, case.support)
    everywhere = case.motion in ("through", "scribble")
    reached = np.unique(mesh.boundary) if everywhere else face_nodes(mesh, "top")
    collider = _scale_collider(COLLIDERS[case.collider], float(np.ptp(mesh.nodes[:, 0])) / 0.1)
    return TissueModel(mesh, materials, fixed, collider, reached.astype(np.int32))


def _scale_collider(collider: Collider, scale: float) -> Collider:
    """Scale a collider, even beyond the sizes that settings allow."""
    scaled = copy.copy(collider)
    for name, size in asdict(collider).items():
        object.__setattr__(scaled, name, scale * size)
    return scaled


def _find_stiff(mesh: TetrahedralMesh, layout: str) -> NDArray[np.bool_]:
    """Find the stiff tetrahedra (M,)."""
    middle = mesh.nodes[mesh.tetrahedra].mean(axis=1)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    place = (middle - low) / (high - low)
    if layout == "inclusion":
        return np.asarray(np.linalg.norm(place - [0.5, 0.5, 0.4], axis=1) < 0.3)
    if layout == "skin":
        return np.asarray(place[:, 2] < 0.3)
    if layout == "half":
        return np.asarray(place[:, 0] < 0.5)
    return np.asarray(np.random.default_rng(7).random(len(middle)) < 0.3)


@lru_cache
def make_mesh(name: str) -> TetrahedralMesh:
    """Make one of `MESHES`, once: its top is z = 0, its bottom the largest z."""
    return MESHES[name]()


def find_fixed_nodes(mesh: TetrahedralMesh, support: str) -> NDArray[np.bool_]:
    """Find the fixed nodes (N,): the "bottom", also the "walls", or "three" of the bottom."""
    nodes = mesh.nodes
    fixed = np.zeros(len(nodes), dtype=bool)
    bottom = face_nodes(mesh, "bottom")
    if support == "three":
        across = nodes[bottom, :2] @ np.array([[1.0, 1, -1], [1, -1, 0.5]])
        fixed[bottom[across.argmax(axis=0)]] = True
        return fixed
    fixed[bottom] = True
    if support == "walls":
        fixed[face_nodes(mesh, "sides")] = True
    return fixed


def _make_box(nx: int, ny: int, nz: int, size: float = 1.0) -> TetrahedralMesh:
    x, y = (uniform_planes(-0.05 * size, 0.05 * size, count) for count in (nx, ny))
    return box_mesh(x, y, uniform_planes(0.0, 0.08 * size, nz))


def _jitter_mesh(mesh: TetrahedralMesh, spread: float, seed: int) -> TetrahedralMesh:
    """Move every node at random; those on a face within their face."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    moved = mesh.nodes + spread * np.random.default_rng(seed).uniform(-1, 1, mesh.nodes.shape)
    on_face = (mesh.nodes == low) | (mesh.nodes == high)
    return TetrahedralMesh(np.where(on_face, mesh.nodes, moved), mesh.tetrahedra)


def _make_delaunay() -> TetrahedralMesh:
    """Make a mesh of scattered points, with slivers."""
    points = _jitter_mesh(_make_box(5, 5, 5), 0.0003, seed=5).nodes
    corners = Delaunay(points).simplices
    a, b, c, d = np.moveaxis(points[corners], 1, 0)
    volume = signed_volumes(points, corners)
    corners[volume < 0] = corners[volume < 0][:, [0, 1, 3, 2]]
    longest = np.max([np.linalg.norm(p - q, axis=1) for p in (a, b, c, d) for q in (a, b, c)], 0)
    corners = corners[np.abs(volume) > 1e-7 * longest**3]
    used, renumbered = np.unique(corners, return_inverse=True)
    return TetrahedralMesh(points[used], renumbered.reshape(corners.shape))


_across = partial(uniform_planes, -0.05, 0.05)

MESHES: dict[str, Callable[[], TetrahedralMesh]] = {
    "box": lambda: _make_box(4, 4, 4),
    "fine": lambda: _make_box(6, 5, 5),
    # Cells a thousand times as wide as thick.
    "layered": lambda: box_mesh(_across(4), _across(4), [0.0, 3e-5, 0.02, 0.02003, 0.08]),
    "perturbed": lambda: _jitter_mesh(_make_box(5, 4, 5), 0.004, seed=3),
    "delaunay": _make_delaunay,
    "slab": lambda: box_mesh(_across(6), _across(6), uniform_planes(0.0, 0.002, 3)),  # a skin
    "millimetre": lambda: _make_box(4, 4, 4, 0.01),
    "ten metres": lambda: _make_box(4, 4, 4, 100.0),
}
"""The tissues by name."""


HOLD = 30  # frames for which the probe stays at the end of its motion
SMALL = 1e-3  # residual to be reached by then


def sample_held_cases(count: int, seed: int) -> list[StabilityCase]:
    """Sample random cases within anatomy, in which tissue under a held probe must balance.

    Moduli are 1 to 100 kPa (the softest), contrasts up to 1000, Poisson's ratios 0.3 to 0.495,
    depths 5 to 50 % of the thickness; modulus, contrast and 0.5 minus Poisson's ratio are even in
    their logarithms.
    """
    random = np.random.default_rng(seed)

    def sample_between(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def choose_name(*names: str) -> str:
        return names[int(random.integers(len(names)))]

    return [
        StabilityCase(
            case=f"held {seed}.{number}",
            young_modulus=10 ** sample_between(3.0, 5.0),
            contrast=10 ** sample_between(0.0, 3.0),
            layout=choose_name(*LAYOUTS),
            poisson_ratio=0.5 - 10 ** sample_between(float(np.log10(0.005)), float(np.log10(0.2))),
            depth=sample_between(0.05, 0.5),
            motion=choose_name("press", "jump", "slide", "tilt", "tremor"),
            mesh=choose_name("box", "fine", "layered", "perturbed", "delaunay", "slab"),
            support=choose_name("bottom", "walls"),
            collider=choose_name("sphere", "capsule", "plate", "pebble"),
            release=choose_name("removed", "lifted"),
            held=HOLD,
        )
        for number in range(count)
    ]


LIFTED = Pose(position=np.array([0.0, 0.0, -100.0]))  # far from any tissue


def make_poses(motion: str, mesh: TetrahedralMesh, depth: float) -> list[Pose | None]:
    """Make the probe's pose in every frame until its release; None while there is no probe.

    Args:
        motion: one of `MOTIONS`.
        mesh: its top is z = 0. The probe is above the node nearest to the middle of the top, so
            that a needle hits one.
        depth: to reach, as a fraction of the mesh's thickness.
    """
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    wide, breadth, thick = high - low
    deep = depth * thick
    top = mesh.nodes[mesh.nodes[:, 2] == low[2], :2]
    nearest = top[np.argmin(np.linalg.norm(top - (low + high)[:2] / 2, axis=1))]
    about = np.array([0.4, 1.0, 0.1]) / np.linalg.norm([0.4, 1.0, 0.1])

    def place_probe(z: float, x: float = 0.0, y: float = 0.0, angle: float = 0.0) -> Pose:
        """Place the probe z (m) deep, x and y widths aside, turned by an angle (rad)."""
        turn = np.append(np.sin(angle / 2) * about, np.cos(angle / 2))
        return Pose(np.array([nearest[0] + x * wide, nearest[1] + y * wide, z]), turn)

    # 1 kHz at 2718 frames a second: no small multiple, so that no phase repeats.
    shakes = 0.02 * thick * np.sin(2 * np.pi * 1000.0 / 2718.0 * np.arange(14))
    stops = (-0.2 * thick, deep, 2.5 * thick, deep, -0.2 * thick, deep)
    random = np.random.default_rng(11)
    places = random.uniform(-0.5, 0.5, (8, 3)) * [wide, breadth, 2 * deep]
    places += [*nearest, deep]
    paths: dict[str, list[Pose | None]] = {
        "press": [place_probe(part * deep) for part in (0.2, 0.4, 0.6, 0.8, 1, 1, 1)],
        "jump": [
            place_probe(deep),
            place_probe(deep),
            place_probe(deep, x=0.2),
            place_probe(0.3 * deep),
        ],
        "through": [place_probe(z) for z in stops],
        "tremor": [place_probe(deep + shake) for shake in shakes],
        "slide": [place_probe(deep, x, 0.3 * x) for x in (0.0, 0.0, 0.1, 0.25, 0.45, 0.7, 0.2)],
        "tilt": [place_probe(deep, angle=angle) for angle in (0.0, 0.2, 0.5, 0.9, 1.4, 1.4, -0.8)],
        "scribble": [Pose(place, random.standard_normal(4)) for place in places],
        "flicker": [
            place_probe(deep),
            None,
            place_probe(0.5 * deep),
            LIFTED,
            place_probe(deep, x=0.1),
            None,
            place_probe(deep),
        ],
    }
    return paths[motion]
