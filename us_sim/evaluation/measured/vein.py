"""The arm's vein pressed shut at the venous pressures of three postures.

The simulated probe presses on one side, where the published cuff lay all around a leg. So beside
the pressure under the probe, the one in the tissue beside the vein is measured, which the cuff
would raise to its own.
"""

from __future__ import annotations

import dataclasses
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
_DEPTH = 20e-3  # m
_BESIDE = (4e-3, 9e-3)  # m from the vein's axis, where the tissue's pressure is taken
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


def press(venous: float, count: int) -> Closing:
    """Press the arm's probe in ``count`` equal steps on the vein with ``venous`` mmHg in it."""
    scene = load_scene("upper_arm")
    volume = volume_of(scene)
    assert scene.tissue is not None
    vein = dataclasses.replace(scene.tissue.materials["vein"], lumen_pressure=venous * MMHG)
    tissue = dataclasses.replace(scene.tissue, materials={**scene.tissue.materials, "vein": vein})
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
    count = 20 if report.quick else 40
    cases = {"no blood": _NO_BLOOD, **VENOUS}
    made = {name: press(cases[name], count) for name in steps("vein", list(cases), "postures")}
    rows, findings = [], []
    for name, closing in made.items():
        pressures = [
            closing.at(area, of) for area in _AREAS for of in (closing.interface, closing.beside)
        ]
        low, high = PUBLISHED.get(name, (float("nan"), float("nan")))
        said = "" if name not in PUBLISHED else f"{low:.0f}" + (f" to {high:.0f}" * (high > low))
        venous = f"{cases[name]:.0f}"
        rows.append((name, venous, said, *map(_whole, pressures)))
        if name in PUBLISHED:
            findings += [
                Finding("vein", name, quantity, "mmHg", 0.5 * (low + high), pressure,
                        pressure - 0.5 * (low + high), 0.5 * (high - low))
                for quantity, pressure in (
                    ("closing pressure, under the probe", pressures[2]),
                    ("closing pressure, beside the vein", pressures[3]),
                )
            ]  # fmt: skip
    file = report.picture("vein")
    _draw(file, made)
    heads = ["posture", "venous", "published"]
    heads += [f"{100 * a:.0f} %, {of}" for a in _AREAS for of in ("probe", "beside")]
    text = filled(
        "measured",
        "vein",
        table=markdown_table(heads, rows),
        closed=f"{100 * _CLOSED:.0f}",
        postures=", ".join(f"{1e-3 * MMHG * VENOUS[p]:.1f} kPa {p}" for p in VENOUS),
        picture=file.name,
    )
    return Section("A vein pressed shut", text, findings)


def _whole(mmhg: float) -> str:
    return f"{mmhg:.0f}" if np.isfinite(mmhg) else "not reached"


def _draw(file: Path, made: Mapping[str, Closing]) -> None:
    with picture(file, 11.0, 5.4, "The arm's vein under a probe, with calf veins' pressures") as f:
        grid = f.add_gridspec(2, 4, height_ratios=[3.0, 1.0])
        for k, (title, of) in enumerate(
            (("under the probe", "interface"), ("in the tissue beside the vein", "beside"))
        ):
            panel = f.add_subplot(grid[0, 2 * k : 2 * k + 2])
            for (name, closing), colour in zip(made.items(), _COLOURS, strict=True):
                label = name if name not in VENOUS else f"{name}, {VENOUS[name]:.0f} mmHg"
                panel.plot(getattr(closing, of), 100 * closing.area, color=colour, label=label)
                if name in PUBLISHED:
                    low, high = PUBLISHED[name]
                    panel.axvspan(low - 0.5, high + 0.5, color=colour, alpha=0.2, lw=0)
            panel.axhline(100 * _CLOSED, color="0.6", lw=0.7)
            panel.set(xlabel=f"pressure {title}, mmHg", ylabel="area of the vein, %", ylim=(0, 102))
            panel.legend(fontsize=8, frameon=False)
            plain(panel)
        for k, (name, closing) in enumerate(made.items()):
            panel = f.add_subplot(grid[1, k])
            moments = (0, len(closing.depth) // 4, len(closing.depth) // 2, len(closing.depth) - 1)
            panel.imshow(np.concatenate([_cropped(closing.sections[m]) for m in moments], axis=1),
                         cmap="gray")  # fmt: skip
            depths = ", ".join(f"{1e3 * closing.depth[m]:.0f}" for m in moments)
            panel.set_title(f"{name}: at {depths} mm", fontsize=9)
            panel.axis("off")


def _cropped(section: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A window of 140 × 240 pixels about the middle of where the lumen is."""
    middles = (x.min() + x.max() for x in np.nonzero(section)) if section.any() else (0, 0)
    row, column = (int(middle) // 2 for middle in middles)
    return np.pad(section, ((70, 70), (120, 120)))[row : row + 140, column : column + 240]


_COLOURS = ("0.5", "tab:blue", "tab:orange", "tab:red")


STUDY = Study(name="vein", folder="", address="", licence="", citation="", measure=measure_vein)
