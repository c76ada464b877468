"""The stiff and extreme cases on which every tissue solver is tried.

>>> from us_sim.evaluation.stability.cases import sampled_cases
>>> cases = sampled_cases(64)
>>> len(cases), cases == sampled_cases(64)
(64, True)
"""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from us_sim.evaluation.stability.meshes import MESHES, fixed_nodes, mesh_named
from us_sim.geometry.collider import Capsule, Collider, RoundedBox, Sphere
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import TissueModel, face_nodes

COLLIDERS: dict[str, Collider] = {
    "sphere": Sphere(0.03),
    "needle": Sphere(0.001),
    "boulder": Sphere(0.4),
    "capsule": Capsule(0.012, 0.04),
    "plate": RoundedBox(0.05, 0.02, 0.03, 0.002),
    "pebble": RoundedBox(0.06, 0.05, 0.05, 0.025),
}
"""Colliders by name, for a tissue 0.1 m wide; they are as much larger or smaller as others are."""

LAYOUTS = ("inclusion", "skin", "half", "scattered")
"""Where a mesh is stiffer by the contrast."""

SPRINGS = ("algorithm_1", "fitted", "fitted with volume")
"""Spring constants of methods that have springs, and whether tetrahedra keep their volumes."""

MOTIONS = (
    *("press", "jump", "through", "tremor", "slide", "tilt", "sideways", "upside down"),
    *("scribble", "flicker"),
)
"""What the probe does, see `us_sim.evaluation.stability.motions`."""

_STIFFEST = 12.0  # decimal logarithm of Pa
_GREATEST_CONTRAST = 9.0  # decimal logarithm
_REACHED_FROM_ALL_SIDES = ("through", "sideways", "upside down", "scribble")


@dataclass(frozen=True)
class StabilityCase:
    """One tissue, how it is held, and what the probe does to it."""

    case: str
    young_modulus: float = 1e4  # Pa, of the softest tetrahedron
    contrast: float = 1.0  # of the stiffest to the softest modulus
    layout: str = "inclusion"  # where it is stiff, see `LAYOUTS`
    poisson_ratio: float = 0.45
    density: float = 1000.0  # kg/m3
    time_step: float = 0.01  # s, of methods that have one
    damping: float = 1.0  # times critical, likewise
    depth: float = 0.25  # of the tissue's thickness
    motion: str = "press"
    mesh: str = "box"
    support: str = "bottom"
    collider: str = "sphere"
    release: str = "removed"  # the probe is "removed" or "lifted"
    stabilisation: str = "mass_scaling"  # of explicit methods
    springs: str = "algorithm_1"  # of methods that have some, see `SPRINGS`
    held: int = 0  # frames that the probe stays where its motion ended, before its release


def sampled_cases(count: int) -> list[StabilityCase]:
    """``count`` (a power of two) cases spread evenly over all ranges: a Sobol sequence's first.

    Those of young_modulus, contrast, density, time_step and damping (but for an eighth without any)
    are even in the logarithm, those of poisson_ratio in lg(0.5 - poisson_ratio).
    """
    points = qmc.Sobol(14, scramble=False).random_base2(round(math.log2(count)))
    return [_sampled(number, point) for number, point in enumerate(points)]


def _sampled(number: int, point: NDArray[np.float64]) -> StabilityCase:
    def one_of(values: tuple[str, ...], fraction: float) -> str:
        return values[int(fraction * len(values))]

    contrast = _GREATEST_CONTRAST * point[1]
    damping = 8 * point[5] / 7 - 1 / 7
    return StabilityCase(
        case=f"sample {number}",
        young_modulus=float(10 ** ((_STIFFEST - contrast) * point[0])),
        contrast=float(10**contrast),
        poisson_ratio=float(0.5 - 0.5 * 10 ** (math.log10(2e-4) * point[2])),
        density=float(10 ** (6 * point[3])),
        time_step=float(10 ** (7 * point[4] - 6)),
        damping=float(10 ** (6 * damping - 3)) if damping >= 0 else 0.0,
        depth=float(point[6]),
        motion=one_of(MOTIONS, point[7]),
        mesh=one_of(tuple(MESHES), point[8]),
        collider=one_of(tuple(COLLIDERS), point[9]),
        layout=one_of(LAYOUTS, point[10]),
        support=one_of(("bottom", "bottom", "bottom", "walls", "three"), point[11]),
        release=one_of(("removed", "lifted"), point[12] * 2 % 1),
        stabilisation=one_of(("mass_scaling",) * 3 + ("substeps",), point[12]),
        springs=one_of(("algorithm_1", "algorithm_1", *SPRINGS[1:]), point[13]),
    )


def extreme_cases(corners: bool) -> list[StabilityCase]:
    """Cases with a name: one extreme at a time, with ``corners`` also combinations of extremes."""
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
        StabilityCase("fitted springs", springs="fitted", motion="jump"),
        StabilityCase("volumes kept", springs=SPRINGS[2], poisson_ratio=0.4999),
        StabilityCase("volumes kept in a jump", springs=SPRINGS[2], motion="jump", depth=0.8),
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
    for support in ("three", "one piece", "nothing", "everything"):
        for mesh in ("box", "two pieces", "tetrahedron"):
            cases.append(StabilityCase(f"{mesh}, held: {support}", mesh=mesh, support=support))
    for collider in COLLIDERS:
        cases.append(StabilityCase(f"{collider} scribbling", collider=collider, motion="scribble"))
    if corners:
        extremes = itertools.product(
            ((1.0, 1.0), (1.0, 1e9), (1e3, 1e9), (1e12, 1.0)),
            (0.0, 0.4999),
            (0.02, 1.0),
            ("press", "jump", "tremor"),
            (1e-6, 10.0),
        )
        for number, ((modulus, contrast), ratio, depth, motion, step) in enumerate(extremes):
            cases.append(
                StabilityCase(
                    f"corner {number}",
                    young_modulus=modulus,
                    contrast=contrast,
                    layout=LAYOUTS[number % len(LAYOUTS)],
                    poisson_ratio=ratio,
                    depth=depth,
                    motion=motion,
                    time_step=step,
                    damping=(0.0, 1e3)[number % 3 % 2],
                    mesh=tuple(MESHES)[number % 7],
                )
            )
    return cases


def model_of(case: StabilityCase) -> TissueModel:
    """The tissue of a case, through the same checks as any other."""
    mesh = mesh_named(case.mesh)
    count = len(mesh.tetrahedra)
    modulus = np.full(count, case.young_modulus)
    modulus[_stiff(mesh, case.layout)] *= case.contrast
    materials = TissueMaterials(
        modulus, np.full(count, case.poisson_ratio), np.full(count, case.density)
    )
    fixed = fixed_nodes(mesh, case.support)
    everywhere = case.motion in _REACHED_FROM_ALL_SIDES
    reached = np.unique(mesh.boundary) if everywhere else face_nodes(mesh, "top")
    collider = _scaled(COLLIDERS[case.collider], float(np.ptp(mesh.nodes[:, 0])) / 0.1)
    return TissueModel(mesh, materials, fixed, collider, reached.astype(np.int32))


def _scaled(collider: Collider, scale: float) -> Collider:
    """The collider so many times as large, also beyond the sizes that settings allow a probe."""
    scaled = copy.copy(collider)
    for name, size in asdict(collider).items():
        object.__setattr__(scaled, name, scale * size)
    return scaled


def _stiff(mesh: TetrahedralMesh, layout: str) -> NDArray[np.bool_]:
    """(M,) which tetrahedra are the stiff ones."""
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
