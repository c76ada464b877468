"""Silicone cylinders compressed to two thirds, and what the law of the tissue predicts.

A modulus comes from the compressions below 5 % of the first specimen of a material, and predicts
the forces on the second one. Nobody said how well the platens slid, so that the truth lies between
two cases: they slid, so that the cylinder stays one, with a closed form; or they stuck, which the
elements of `fem_nonlinear` solve up to a fifth of compression; beyond, the side folds onto them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.evaluation.figures import draw_error_over_parameter
from us_sim.evaluation.measured.hydrogel import balance
from us_sim.evaluation.subject import Piece, Place
from us_sim.geometry.collider import Sphere
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.newton import Newton

Array = NDArray[np.float64]

RADIUS, HEIGHT = 0.025, 0.03  # m
_STEP = 0.01
COMPRESSIONS = np.arange(0.0, 0.6651, _STEP)  # parts of the height, at which forces are compared
_FITTED = 0.05  # compression up to which a modulus is fitted
_STIFFENED = 0.60  # compression at which a stiffening is fitted
_SLIDING, _STICKING = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.66), (0.05, 0.1, 0.15, 0.2)
_HEADING = "Time (s)"
_POISSON_RATIO = 0.49  # nearly incompressible; 0.4999 resists a small compression by 2 % more
_BALANCED = 1e-4  # unbalanced force over the platen's


def at(compression: float) -> int:
    """Return the index in `COMPRESSIONS`."""
    return round(compression / _STEP)


@dataclass(frozen=True, eq=False)
class Silicone:
    """Forces of the tests of one material."""

    name: str
    first: Array  # (T, C) N, of one specimen
    second: Array  # (U, C) N, of the other

    @property
    def scatter(self) -> Array:
        """(C,), standard deviation of a test over the mean of all."""
        tests = np.concatenate([self.first, self.second])
        mean = tests.mean(axis=0)
        return np.divide(tests.std(axis=0, ddof=1), mean, out=np.zeros_like(mean), where=mean > 0)


def read_test(file: Path) -> Array:
    """(C,) N, forces of a test at `COMPRESSIONS`.

    Raises:
        UsSimError: the file is no such test, or ends before it is pressed that far.
    """
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    start = next((k for k, line in enumerate(lines) if line.startswith(_HEADING)), None)
    if start is None:
        raise UsSimError(f"{file}: has no line that begins with {_HEADING}: is it a compression?")
    rows = []
    for number, line in enumerate(lines[start + 1 :], start + 2):
        try:
            millimetres, newtons = (float(text) for text in line.split(",")[1:3])
        except ValueError as error:
            raise UsSimError(
                f"{file}:{number}: is no row of time, compression and load: {line[:60]}"
            ) from error
        rows.append((millimetres, newtons))
    table = np.array(rows).reshape(-1, 2)
    part = 1e-3 * np.maximum.accumulate(table[:, 0]) / HEIGHT
    if not np.isfinite(table).all() or not len(table) or part[-1] < COMPRESSIONS[-1]:
        raise UsSimError(
            f"{file}: ends before {100 * COMPRESSIONS[-1]:.0f} % of compression, or holds numbers "
            f"that are none: fetch it again"
        )
    return np.interp(COMPRESSIONS, part, table[:, 1])


def read_silicones(folder: Path) -> list[Silicone]:
    """All materials in a folder of folders, by name.

    Raises:
        UsSimError: there is none, or one has no test of a specimen A or B.
    """
    found = []
    for place in sorted(path for path in folder.glob("*") if path.is_dir()):
        tests = [sorted(place.glob(f"*_{specimen}[0-9].csv")) for specimen in "AB"]
        if not all(tests):
            raise UsSimError(f"{place}: needs tests of specimens A and B, NAME_A1.csv and so on")
        first, second = (np.stack([read_test(file) for file in files]) for files in tests)
        found.append(Silicone(place.name, first, second))
    if not found:
        raise UsSimError(f"{folder}: holds no folder of a silicone's compressions")
    return found


def slipping_force(compression: Array, stiffening: float = 0.0) -> Array:
    """(C,) m2, force over shear modulus of an incompressible cylinder that slides at the platens.

    A pi R^2 (1 + s e^2) (1 / l^2 - l), with l = 1 - compression and e = (l^2 + 2 / l - 3) / 2.
    """
    left = 1.0 - compression
    beyond = (left**2 + 2.0 / left - 3.0) / 2.0
    area = math.pi * RADIUS**2
    return np.asarray(area * (1.0 + stiffening * beyond**2) * (left**-2 - left))


def sticking_force(compressions: Sequence[float], cells: int) -> Array:
    """(C,) m2, force over shear modulus of a cylinder that sticks to the platens.

    Args:
        compressions: rising, parts of the height.
        cells: across the cylinder and along it.

    Raises:
        SolverError: the cylinder does not come to balance.
    """
    side, even = np.linspace(-1, 1, cells + 1), np.linspace(0, 1, cells + 1)
    box = box_mesh(side, side, (even + (1 - np.cos(np.pi * even)) / 2) / 2)  # thinner at platens
    x, y, z = box.nodes.T
    disc = np.stack([x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)])
    mesh = TetrahedralMesh(np.column_stack([*(RADIUS * disc), HEIGHT * z]), box.tetrahedra)
    materials = uniform_material(mesh, Material(2 * (1 + _POISSON_RATIO), _POISSON_RATIO))
    moved = z < 1e-9
    nobody = np.zeros(0, dtype=np.int32)
    newton = Newton(TissueModel(mesh, materials, moved | (z > 1 - 1e-9), Sphere(RADIUS), nobody))
    tissue, slope = NeoHookean(mesh, materials, np.float64), np.empty((3, len(z)))
    forces, before = [], 0.0
    for compression in compressions:
        pressed = newton.displacement.copy()
        pressed[2] += (compression - before) * HEIGHT * (1 - z)
        newton.set_displacement(pressed)
        balance(newton, _BALANCED * float(slipping_force(np.array(compression))))
        tissue.energy_and_forces(newton.displacement, slope)
        forces.append(float(slope[2, moved].sum()))
        before = compression
    return np.array(forces)


def fit_modulus(forces: Array, per_modulus: Array) -> float:
    """Pa, the shear modulus that fits forces (C,) N up to 5 % of compression best."""
    small = slice(1, at(_FITTED) + 1)
    model = per_modulus[small]
    return float(model @ forces[small] / (model @ model))


def fit_stiffening(forces: Array, modulus: float) -> float:
    """Return the stiffening with which the sliding cylinder has the force at 60 %; none below 0."""
    there = COMPRESSIONS[at(_STIFFENED)]
    plain, stiff = (float(slipping_force(np.array(there), s)) for s in (0.0, 1.0))
    return max(0.0, float((forces[at(_STIFFENED)] / modulus - plain) / (stiff - plain)))


def predict_silicones(folder: Path, platens: str, cells: int) -> Iterator[dict[str, Any]]:
    """Predict the second specimen's forces as the first one's constants say: medians of errors."""
    silicones = read_silicones(folder)
    scatter = np.median([silicone.scatter for silicone in silicones], axis=0)
    laws: dict[str, list[Array]] = {"neo-Hookean": []}
    if platens == "slip":
        laws["stiffening, s from 60 %"] = []
    else:
        coarse = np.array([0.0, 0.01, 0.03, *_STICKING])
        ratio = sticking_force(coarse[1:].tolist(), cells) / slipping_force(coarse[1:])
        per_modulus = slipping_force(COMPRESSIONS) * np.interp(COMPRESSIONS, coarse[1:], ratio)
    for silicone in silicones:
        first, second = silicone.first.mean(axis=0), silicone.second.mean(axis=0)
        curve = slipping_force(COMPRESSIONS) if platens == "slip" else per_modulus
        modulus = fit_modulus(first, curve)
        laws["neo-Hookean"].append(modulus * curve / np.maximum(second, 1e-9) - 1)
        if platens == "slip":
            stiffer = slipping_force(COMPRESSIONS, fit_stiffening(first, modulus))
            error = modulus * stiffer / np.maximum(second, 1e-9) - 1
            laws["stiffening, s from 60 %"].append(error)
    for law, errors in laws.items():
        stiffened = law != "neo-Hookean"
        for compression in _SLIDING if platens == "slip" else _STICKING[1::2]:
            if stiffened and compression == _STIFFENED:
                continue  # it is fitted there
            yield {
                "case": f"median of {len(silicones)} silicones",
                "quantity": f"force at {100 * compression:.0f} %, {platens}, {law}",
                "unit": "%",
                "error": 100 * float(np.median(np.abs(errors), axis=0)[at(compression)]),
                "floor": 100 * float(scatter[at(compression)]),
                "fitted_on": "specimen A: below 5 %" + " and at 60 %" * stiffened,
                "line": f"{platens}, {law}",
                "x": 100 * compression,
            }


def plan_silicone(folder: Path, quick: bool) -> list[Piece]:
    """Predict with platens that slide, and with ones that stick."""
    run = partial(predict_silicones, folder / "data", cells=8 if quick else 14)
    return [
        Piece({"study": "silicone"}, partial(run, platens=platens)) for platens in ("slip", "stick")
    ]


def report_silicone(rows: pd.DataFrame) -> tuple[str, dict[str, Place]]:
    """Say how far the forces are off, by compression."""
    scatter = rows.assign(error=rows["floor"], line="scatter of the tests").drop_duplicates("x")
    figure = draw_error_over_parameter(
        *(pd.concat([rows, scatter]), "x", "error", "Silicones: median error of the force"),
        lines="line",
        log="",
        labels={"x": "compression, %", "error": "error of the force, %"},
    )
    slip = rows[rows["line"] == "slip, neo-Hookean"].set_index("x")["error"]
    words = (
        f"Silicones: a modulus fitted below 5 % of compression predicts the force to "
        f"{slip[30.0]:.0f} % at 30 %, and to {slip[66.0]:.0f} % at 66 %, where they stiffen."
    )
    table = rows.assign(x=rows["x"].map("{:.0f} %".format))
    table = table.pivot_table("error", "line", "x", sort=False).reset_index()
    return words, {"silicone": figure, "silicone_table": table}
