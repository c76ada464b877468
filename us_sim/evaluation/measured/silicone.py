"""Silicone cylinders compressed by two thirds, against the law of the tissue.

A modulus is fitted to the compressions below 5 % of the first specimen of a material. It predicts
the forces on the second one, by the closed form of a cylinder that slides at its platens.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.evaluation.subject import Piece, Place

Array = NDArray[np.float64]

RADIUS, HEIGHT = 0.025, 0.03  # m
_STEP = 0.01
COMPRESSIONS = np.arange(0.0, 0.6651, _STEP)  # of the height, at which forces are compared
_FITTED = 0.05  # compression up to which a modulus is fitted
_COMPARED = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.66)
_HEADING = "Time (s)"


def find_index(compression: float) -> int:
    """Return the index of a compression in `COMPRESSIONS`."""
    return round(compression / _STEP)


@dataclass(frozen=True, eq=False)
class Silicone:
    """Forces of the tests of one material."""

    name: str
    first: Array  # (T, C) N, of one specimen
    second: Array  # (U, C) N, of the other

    @property
    def scatter(self) -> Array:
        """(C,), standard deviation of the tests over their mean."""
        tests = np.concatenate([self.first, self.second])
        mean = tests.mean(axis=0)
        return np.divide(tests.std(axis=0, ddof=1), mean, out=np.zeros_like(mean), where=mean > 0)


def read_test(file: Path) -> Array:
    """Read the forces (C,) N of a test at `COMPRESSIONS`.

    Raises:
        UsSimError: the file is no such test, or ends before the last compression.
    """
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    heading = [line.startswith(_HEADING) for line in lines]
    if not any(heading):
        raise UsSimError(f"{file}: has no line that begins with {_HEADING}: is it a compression?")
    try:
        rows = lines[heading.index(True) + 1 :]
        table = np.loadtxt(rows, delimiter=",", usecols=(1, 2), ndmin=2)
    except ValueError as error:
        raise UsSimError(f"{file}: below {_HEADING}: {error}; fetch it again") from error
    part = 1e-3 * np.maximum.accumulate(table[:, 0]) / HEIGHT
    if not np.isfinite(table).all() or not len(table) or part[-1] < COMPRESSIONS[-1]:
        raise UsSimError(
            f"{file}: ends before {100 * COMPRESSIONS[-1]:.0f} % of compression, or holds numbers "
            f"that are none: fetch it again"
        )
    return np.interp(COMPRESSIONS, part, table[:, 1])


def read_silicones(folder: Path) -> list[Silicone]:
    """Read all materials in a folder of folders, in the order of their names.

    Raises:
        UsSimError: there is none, or one lacks tests of specimen A or B.
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


def compute_slipping_force(compression: Array) -> Array:
    """Compute force over shear modulus (C,) m2 of an incompressible cylinder that slides.

    It is pi R^2 (1 / l^2 - l), with l = 1 - compression.
    """
    left = 1.0 - compression
    return np.asarray(math.pi * RADIUS**2 * (left**-2 - left))


def fit_modulus(forces: Array) -> float:
    """Fit the shear modulus (Pa) to forces (C,) N up to 5 % of compression."""
    small = slice(1, find_index(_FITTED) + 1)
    model = compute_slipping_force(COMPRESSIONS[small])
    return float(model @ forces[small] / (model @ model))


def predict_silicones(folder: Path) -> Iterator[dict[str, Any]]:
    """Predict each second specimen from the first one's modulus; yield median errors."""
    silicones = read_silicones(folder)
    scatter = np.median([silicone.scatter for silicone in silicones], axis=0)
    errors = []
    for silicone in silicones:
        predicted = fit_modulus(silicone.first.mean(axis=0)) * compute_slipping_force(COMPRESSIONS)
        errors.append(predicted / np.maximum(silicone.second.mean(axis=0), 1e-9) - 1)
    for compression in _COMPARED:
        yield {
            "case": f"median of {len(silicones)} silicones",
            "quantity": f"force at {100 * compression:.0f} %",
            "unit": "%",
            "error": 100 * float(np.median(np.abs(errors), axis=0)[find_index(compression)]),
            "floor": 100 * float(scatter[find_index(compression)]),
            "fitted_on": "specimen A: below 5 %",
            "x": 100 * compression,
        }


def plan_silicone(folder: Path, _: bool) -> list[Piece]:
    """Plan the prediction of all materials."""
    return [Piece({"study": "silicone"}, partial(predict_silicones, folder / "data"))]


def report_silicone(rows: pd.DataFrame) -> tuple[str, dict[str, Place]]:
    """Report the errors of the forces, by compression."""
    predicted = rows.set_index("x")["error"]
    words = (
        f"Silicones: a modulus fitted below 5 % of compression predicts the force to "
        f"{predicted[30.0]:.0f} % at 30 %, and to {predicted[66.0]:.0f} % at 66 %, where they "
        f"stiffen."
    )
    table = rows[["quantity", "error", "floor"]]
    table.columns = pd.Index(["quantity", "error, %", "scatter of the tests, %"])
    return words, {"silicone_table": table}
