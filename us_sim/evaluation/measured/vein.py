"""The arm's vein pressed shut at the venous pressures of three postures.

The simulated probe presses on one side, where the published cuff lay all around a leg. So beside
the pressure under the probe, the one in the tissue beside the vein is measured, which the cuff
would raise to its own.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.measured.study import Finding, Section, Study
from us_sim.evaluation.report import ReportFolder, filled, markdown_table, picture, plain
from us_sim.evaluation.timing import steps
from us_sim.geometry.pose import Pose
from us_sim.scene.building import scanner_of, tissue_model_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.tissue.elasticity.material import KINDS
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import create_solver

Array = NDArray[np.float64]

MMHG = 133.322  # Pa
_ANKLE = {"lying": 7.0, "standing": 79.0}
"""mmHg at 28 °C, in ten people (Venous pressure in the saphenous vein near the ankle during changes
in posture and exercise at different ambient temperatures, Eur. J. Appl. Physiol. 66, 1993)."""
_CALF_ABOVE_ANKLE, _THIGH = 0.2, 0.42  # m, taken here
_COLUMN = 1060.0 * 9.81 / MMHG  # mmHg/m of blood
VENOUS = {
    "lying": _ANKLE["lying"],
    "sitting": _ANKLE["standing"] - _COLUMN * (_CALF_ABOVE_ANKLE + _THIGH),
    "standing": _ANKLE["standing"] - _COLUMN * _CALF_ABOVE_ANKLE,
}
"""mmHg in the veins of the middle of the calf."""
PUBLISHED = {"lying": (20.0, 25.0), "sitting": (50.0, 60.0), "standing": (70.0, 70.0)}
"""mmHg of a cuff that occludes leg veins (B. Partsch and H. Partsch, Calf compression pressure
required to achieve venous closure from supine to standing positions, J. Vasc. Surg. 42, 2005)."""
_NO_BLOOD = 0.01  # mmHg, for the force that the tissue alone needs
_AREAS = (0.5, 0.2, 0.1)  # parts of that at rest
_CLOSED = 0.2
"""Of them, the one that counts as closed. Below it the mesh holds the vein open, of whose
tetrahedra most are lumen in part only: see `us_sim.tissue.elasticity.neo_hookean_material`."""
_SOFT = 50e3  # Pa; what is stiffer is artery or bone, and not soft tissue
_DEPTH = 22e-3  # m; deeper, the probe would enter the tissue
_LAYERS = ("skin", "fat", "muscle")
MODULI: Mapping[str, Mapping[str, float]] = {
    "of the scene": {},
    "of volunteers": {layer: KINDS[layer].young_modulus for layer in _LAYERS},
}
"""Pa, moduli that take the place of the scene's; those of volunteers as `material` cites them."""
_BESIDE = (4e-3, 9e-3)  # m from the vein's axis, where the tissue's pressure is taken
_ALONG = 10  # planes of the scene along the vein
_HALF_LENGTH = 8e-3  # m, along the vein


@dataclass(frozen=True, eq=False)
class Closing:
    """A vein under a probe that is pressed step by step."""

    depth: Array  # (K,) m
    area: Array  # (K,) of the lumen, over that at rest
    interface: Array  # (K,) mmHg, force over the area that the probe touches
    beside: Array  # (K,) mmHg, mean pressure of the solid tissue beside the vein
    sections: Sequence[NDArray[np.bool_]]  # (rows, columns), the lumen in the image

    def at(self, area: float, of: Array) -> float:
        """A pressure where the area first falls to this; NaN where it does not."""
        below = np.flatnonzero(self.area <= area)
        if not len(below):
            return float("nan")
        k = below[0]
        return float(np.interp(area, self.area[[k, k - 1]], of[[k, k - 1]]))


def round_vein_pressure(young_modulus: float, area: float) -> float:
    """Pa, all round and above the vein's own, that narrow a round vein to a part of its area.

    Of a long hole in endless incompressible neo-Hookean tissue that stays round: the equilibrium
    d sigma_r / dr = mu (l^2 - l^-2) / r, with l = r / R, from the hole's edge to infinity.
    """
    return young_modulus / 6.0 * (1.0 / area - 1.0 - math.log(area))


def press(
    venous: float, count: int, moduli: Mapping[str, float] | None = None, *, finer: bool = False
) -> Closing:
    """Press the arm's probe in ``count`` equal steps on the vein with ``venous`` mmHg in it.

    ``moduli`` (Pa) take the place of Young's moduli of the scene; the mesh may have twice as many
    planes across the vein.
    """
    scene = load_scene("upper_arm")
    volume = volume_of(scene)
    assert scene.tissue is not None
    materials = dict(scene.tissue.materials)
    materials["vein"] = dataclasses.replace(materials["vein"], lumen_pressure=venous * MMHG)
    for layer, young in (moduli or {}).items():
        materials[layer] = dataclasses.replace(materials[layer], young_modulus=young)
    mesh = scene.tissue.mesh
    if finer:
        planes = {axis: _halved(mesh.planes[axis]) for axis in ("x", "z")}
        nodes = (len(planes["x"]), _ALONG, len(planes["z"]))
        mesh = dataclasses.replace(mesh, planes=planes, nodes=nodes)
    tissue = dataclasses.replace(scene.tissue, materials=materials, mesh=mesh)
    scene = dataclasses.replace(scene, tissue=tissue)
    model = tissue_model_of(scene, volume)
    scanner = scanner_of(scene, volume)
    scanner.carry(model.mesh.nodes, model.mesh.tetrahedra)
    (label,) = (number for number, name in volume.label_names.items() if name == "vein")
    solver = create_solver("fem_nonlinear", model)
    beside = _beside(model)
    depths = np.linspace(0.0, _DEPTH, count + 1)
    rows = []
    sections = []
    for depth in depths:
        pose = Pose(np.array([0.0, 0.0, depth]))
        for _ in range(5):
            made = solver.deform(pose)
        lumen = scanner.labels(pose, made.nodes) == label
        touched = _touched_area(model, made.nodes, made.contact_nodes)
        interface = np.linalg.norm(made.force) / touched if touched else 0.0
        pressure = mean_pressure(model, made.nodes)
        around = np.average(pressure[beside], weights=model.mesh.volumes[beside])
        rows.append((lumen.sum(), interface, around))
        sections.append(lumen)
    area, interface_pa, beside_pa = np.array(rows, np.float64).T
    return Closing(depths, area / area[0], interface_pa / MMHG, beside_pa / MMHG, sections)


def _halved(planes: Sequence[float]) -> tuple[float, ...]:
    """Planes, and those in the middles between them."""
    middles = (sum(pair) / 2 for pair in itertools.pairwise(planes))
    return tuple(sorted([*planes, *middles]))


def mean_pressure(model: TissueModel, nodes: Array) -> Array:
    """(M,) Pa, minus a third of the trace of the Cauchy stress of each solid tetrahedron.

    From the energy that `neo_hookean_material` states, without its barrier and without stiffening.
    """
    tetrahedra, materials = model.mesh.tetrahedra, model.materials
    rest, now = ((x[tetrahedra[:, 1:]] - x[tetrahedra[:, :1]]) for x in (model.mesh.nodes, nodes))
    gradient = np.linalg.solve(rest, now)  # transposed
    ratio = np.linalg.det(gradient)
    young, poisson = materials.young_modulus, materials.poisson_ratio
    shear = young / (2.0 * (1.0 + poisson))
    bulk = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)) + shear
    squared = (gradient**2).sum(axis=(1, 2))
    return np.asarray(-(shear * squared / (3.0 * ratio) + bulk * (ratio - 1.0) - shear))


def _beside(model: TissueModel) -> NDArray[np.bool_]:
    """(M,) which solid tetrahedra lie beside the vein, under the middle of the probe."""
    middle = model.mesh.nodes[model.mesh.tetrahedra].mean(axis=1)
    lumen = model.materials.lumen_fraction
    near = (lumen > 0.5) & (np.abs(middle[:, 1]) < _HALF_LENGTH)
    off = np.linalg.norm((middle - middle[near].mean(axis=0))[:, [0, 2]], axis=1)
    chosen = (lumen == 0.0) & (model.materials.young_modulus < _SOFT)
    chosen &= (off > _BESIDE[0]) & (off < _BESIDE[1])
    return np.asarray(chosen & (np.abs(middle[:, 1]) < _HALF_LENGTH))


def _touched_area(model: TissueModel, nodes: Array, touched: NDArray[np.integer]) -> float:
    """m², a third of the surface's triangles for each corner that is touched."""
    faces = np.sort(model.mesh.tetrahedra[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]], axis=2)
    candidate = faces.reshape(-1, 3)
    candidate = candidate[np.isin(candidate, model.contact_nodes).all(axis=1)]
    surface, counts = np.unique(candidate, axis=0, return_counts=True)
    surface = surface[counts == 1]
    a, b, c = (nodes[surface[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float((areas * np.isin(surface, touched).sum(axis=1)).sum() / 3.0)


def measure_vein(folder: Path, report: ReportFolder) -> Section:  # noqa: ARG001
    """Press the vein shut in each posture, without data, and draw it."""
    count = 22 if report.quick else 44
    cases = {"no blood": _NO_BLOOD, **VENOUS}
    work = list(itertools.product(MODULI, cases))
    made = {
        (moduli, name): press(cases[name], count, MODULI[moduli])
        for moduli, name in steps("vein", work, "presses", ", ".join)
    }
    rows, findings = [], []
    for (moduli, name), closing in made.items():
        pressures = [
            closing.at(area, of) for area in _AREAS for of in (closing.interface, closing.beside)
        ]
        low, high = PUBLISHED.get(name, (float("nan"), float("nan")))
        said = "" if name not in PUBLISHED else f"{low:.0f}" + (f" to {high:.0f}" * (high > low))
        rows.append((moduli, name, f"{cases[name]:.0f}", said, *map(_whole, pressures)))
        if name in PUBLISHED:
            findings += [
                Finding("vein", f"{name}, moduli {moduli}", f"closing pressure, {where}", "mmHg",
                        0.5 * (low + high), pressure, pressure - 0.5 * (low + high),
                        0.5 * (high - low), headline=where == "under the probe")
                for where, pressure in (
                    ("under the probe", pressures[2]), ("beside the vein", pressures[3])
                )
            ]  # fmt: skip
    file = report.picture("vein")
    _draw(file, made)
    heads = ["moduli", "posture", "venous", "published"]
    heads += [f"{100 * a:.0f} %, {of}" for a in _AREAS for of in ("probe", "beside")]
    scene = load_scene("upper_arm").tissue
    assert scene is not None
    of_scene = {layer: scene.materials[layer].young_modulus for layer in _LAYERS}
    share = sum(PUBLISHED["lying"]) / 2 - VENOUS["lying"]
    lying, finer = made["of the scene", "lying"], press(VENOUS["lying"], count, finer=True)
    changes = [finer.at(_CLOSED, finer.interface) - lying.at(_CLOSED, lying.interface)]
    changes += [finer.at(_CLOSED, finer.beside) - lying.at(_CLOSED, lying.beside)]
    alone = [made[moduli, "no blood"] for moduli in MODULI]
    text = filled(
        "measured",
        "vein",
        table=markdown_table(heads, rows),
        closed=f"{100 * _CLOSED:.0f}",
        postures=", ".join(f"{1e-3 * MMHG * VENOUS[p]:.1f} kPa {p}" for p in VENOUS),
        scene=_kilopascals(of_scene),
        volunteers=_kilopascals(MODULI["of volunteers"]),
        share=f"{share:.0f}",
        depth=f"{1e3 * _DEPTH:g}",
        changes=" and ".join(f"{change:+.0f}" for change in changes),
        alone=" and ".join(_whole(one.at(_CLOSED, one.interface)) for one in alone),
        cuff=_whole(round_vein_pressure(KINDS["muscle"].young_modulus, _CLOSED) / MMHG),
        cuff_fat=_whole(round_vein_pressure(KINDS["fat"].young_modulus, _CLOSED) / MMHG),
        asked=f"{1e-3 * MMHG * share / round_vein_pressure(1.0, _CLOSED):.1f}",
        picture=file.name,
    )
    return Section("A vein pressed shut", text, findings)


def _kilopascals(moduli: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {1e-3 * young:g} kPa" for name, young in moduli.items())


def _whole(mmhg: float) -> str:
    return f"{mmhg:.0f}" if np.isfinite(mmhg) else "not reached"


def _draw(file: Path, made: Mapping[tuple[str, str], Closing]) -> None:
    colours = dict(zip(("no blood", *VENOUS), _COLOURS, strict=True))
    with picture(file, 11.0, 8.2, "The arm's vein under a probe, with calf veins' pressures") as f:
        grid = f.add_gridspec(3, 4, height_ratios=[3.0, 3.0, 1.2])
        for row, moduli in enumerate(MODULI):
            for k, (where, of) in enumerate(
                (("under the probe", "interface"), ("in the tissue beside the vein", "beside"))
            ):
                panel = f.add_subplot(grid[row, 2 * k : 2 * k + 2])
                for name, colour in colours.items():
                    closing = made[moduli, name]
                    label = name if name not in VENOUS else f"{name}, {VENOUS[name]:.0f} mmHg"
                    panel.plot(getattr(closing, of), 100 * closing.area, color=colour, label=label)
                    if name in PUBLISHED:
                        low, high = PUBLISHED[name]
                        panel.axvspan(low - 0.5, high + 0.5, color=colour, alpha=0.2, lw=0)
                panel.axhline(100 * _CLOSED, color="0.6", lw=0.7)
                panel.text(1, 100 * _CLOSED - 1, "closed", fontsize=8, color="0.4", va="top")
                panel.set_title(f"pressure {where}, moduli {moduli}", fontsize=10, loc="left")
                panel.set(xlabel="mmHg (bands: published)", ylabel="area of the vein, %",
                          xlim=(0, 90), ylim=(0, 102))  # fmt: skip
                panel.legend(fontsize=8, frameon=False, loc="upper right")
                plain(panel)
        for k, name in enumerate(colours):
            closing = made["of the scene", name]
            panel = f.add_subplot(grid[2, k])
            moments = (0, len(closing.depth) // 4, len(closing.depth) // 2, len(closing.depth) - 1)
            shown = [_cropped(closing.sections[m]) for m in moments]
            panel.imshow(np.vstack([np.hstack(shown[:2]), np.hstack(shown[2:])]), cmap="gray")
            depths = ", ".join(f"{1e3 * closing.depth[m]:.3g}" for m in moments)
            panel.set_title(f"{name}: at {depths} mm", fontsize=9)
            panel.axis("off")


def _cropped(section: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A window of 90 × 160 pixels about the middle of where the lumen is."""
    middles = (x.min() + x.max() for x in np.nonzero(section)) if section.any() else (0, 0)
    row, column = (int(middle) // 2 for middle in middles)
    return np.pad(section, ((45, 45), (80, 80)))[row : row + 90, column : column + 160]


_COLOURS = ("0.5", "tab:blue", "tab:orange", "tab:red")


STUDY = Study(name="vein", folder="", address="", licence="", citation="", measure=measure_vein)
