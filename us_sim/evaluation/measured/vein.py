"""The arm's vein pressed shut at the venous pressures of three postures.

The simulated probe presses on one side, where the published cuff lay all around a leg.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.evaluation.figures import draw_lines
from us_sim.evaluation.subject import Piece, Place
from us_sim.geometry.pose import Pose
from us_sim.scene.building import build_scanner, build_tissue_model, load_volume
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
_CLOSED = 0.2
"""Part of the area at rest that counts as closed. Below it the mesh holds the vein open, since most
of its tetrahedra are lumen in part only: see `us_sim.tissue.elasticity.neo_hookean_material`."""
_DEPTH = 22e-3  # m; deeper, the probe would enter the tissue
MODULI: Mapping[str, Mapping[str, float]] = {
    "of the scene": {},
    "of volunteers": {"skin": 30e3, "fat": 3e3, "muscle": 11e3},
}
"""Pa, moduli in place of the scene's. Those of volunteers: muscle by shear-wave elastography of 127
people (Arda et al., 2011), fat and skin by aspiration in vivo."""


@dataclass(frozen=True, eq=False)
class ClosingCurve:
    """A vein under a probe that is pressed step by step."""

    area: Array  # (K,) of the lumen, over that at rest
    pressure: Array  # (K,) mmHg, force over the area that the probe touches

    def find_pressure(self, area: float) -> float:
        """Find the pressure (mmHg) at which the area first falls to this; NaN if it never does."""
        below = np.flatnonzero(self.area <= area)
        if not len(below):
            return float("nan")
        k = below[0]
        return float(np.interp(area, self.area[[k, k - 1]], self.pressure[[k, k - 1]]))


def press_vein(
    venous: float, count: int, moduli: Mapping[str, float] | None = None
) -> ClosingCurve:
    """Press the arm's probe in ``count`` equal steps on the vein with ``venous`` mmHg in it.

    ``moduli`` (Pa) replace Young's moduli of the scene, by layer.
    """
    scene = load_scene("upper_arm")
    volume = load_volume(scene)
    assert scene.tissue is not None
    materials = dict(scene.tissue.materials)
    materials["vein"] = dataclasses.replace(materials["vein"], lumen_pressure=venous * MMHG)
    for layer, young in (moduli or {}).items():
        materials[layer] = dataclasses.replace(materials[layer], young_modulus=young)
    tissue = dataclasses.replace(scene.tissue, materials=materials)
    scene = dataclasses.replace(scene, tissue=tissue)
    model = build_tissue_model(scene, volume)
    scanner = build_scanner(scene, volume)
    scanner.attach_mesh(model.mesh.nodes, model.mesh.tetrahedra)
    (label,) = (number for number, name in volume.label_names.items() if name == "vein")
    solver = create_solver("fem_nonlinear", model)
    rows = []
    for depth in np.linspace(0.0, _DEPTH, count + 1):
        pose = Pose(np.array([0.0, 0.0, depth]))
        for _ in range(5):
            made = solver.deform(pose)
        lumen = scanner.render_labels(pose, made.nodes) == label
        touched = _compute_touched_area(model, made.nodes, made.contact_nodes)
        rows.append((lumen.sum(), np.linalg.norm(made.force) / touched if touched else 0.0))
    area, pressure = np.array(rows, np.float64).T
    return ClosingCurve(area / area[0], pressure / MMHG)


def _compute_touched_area(model: TissueModel, nodes: Array, touched: NDArray[np.integer]) -> float:
    """Compute the touched area (m²): a third of a triangle for each touched corner."""
    surface = model.mesh.boundary
    surface = surface[np.isin(surface, model.contact_nodes).all(axis=1)]
    a, b, c = (nodes[surface[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float((areas * np.isin(surface, touched).sum(axis=1)).sum() / 3.0)


def measure_closing(posture: str, moduli: str, count: int) -> Iterator[dict[str, Any]]:
    """Press the vein of a posture shut, and compare the pressures with the published ones."""
    closing = press_vein(VENOUS[posture], count, MODULI[moduli])
    low, high = PUBLISHED[posture]
    middle, pressure = 0.5 * (low + high), closing.find_pressure(_CLOSED)
    yield {
        "case": f"{posture}, moduli {moduli}",
        "quantity": "closing pressure, under the probe",
        "unit": "mmHg",
        "measured": middle,
        "predicted": pressure,
        "error": pressure - middle,
        "floor": 0.5 * (high - low),
        "panel": f"moduli {moduli}",
        "line": posture,
        "curve": np.stack([closing.pressure, 100 * closing.area], axis=1),
    }


def plan_vein(_: Path, quick: bool) -> list[Piece]:
    """Plan each posture with each set of moduli; no data are needed."""
    count = 22 if quick else 44
    return [
        Piece({"study": "vein"}, partial(measure_closing, posture, moduli, count))
        for moduli, posture in itertools.product(MODULI, VENOUS)
    ]


def report_vein(rows: pd.DataFrame) -> tuple[str, dict[str, Place]]:
    """Report the pressures at which the vein closes, and draw the curves."""
    points = pd.DataFrame(
        [
            {"panel": row.panel, "line": row.line, "pressure": pressure, "area": area}
            for row in rows.itertuples()
            for pressure, area in row.curve
        ]
    )
    figure = draw_lines(
        *(points, "pressure", "area", "The arm's vein under a probe, at calf veins' pressures"),
        panels="panel",
        lines="line",
        labels={"pressure": "mmHg", "area": "area of the vein, %"},
        limits={"y:closed": 100 * _CLOSED},
    )
    scene = rows[rows["panel"] == "moduli of the scene"]
    found = [f"{row.line} {row.predicted:.0f} ({row.measured:.3g})" for row in scene.itertuples()]
    words = (
        f"A vein closes under the probe at {', '.join(found)} mmHg; in brackets the published "
        f"pressure of a cuff."
    )
    columns = ["case", "measured", "predicted", "error"]
    return words, {"vein": figure, "vein_table": rows[columns]}
