"""Points of the tissue that were seen while it was pressed: where they are at rest, and then.

A CSV has the columns name, time, x, y, z: seconds since the first pose of the recording, and metres
in frame ``patient`` or with a unit. A row without a time says where the point is at rest.

>>> import pathlib, tempfile
>>> from us_sim.tissue.identification.landmarks import read_landmarks
>>> with tempfile.TemporaryDirectory() as folder:
...     file = pathlib.Path(folder, "seen.csv")
...     _ = file.write_text("name,time,x,y,z\\nbranch,,0,0,20 mm\\nbranch,2.5,0,0,22 mm\\n")
...     seen = read_landmarks(file)
>>> seen.names, seen.rest.tolist(), seen.times.tolist(), seen.places[0].tolist()
(('branch',), [[0.0, 0.0, 0.02]], [2.5], [0.0, 0.0, 0.022])
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import StiffnessError
from us_sim.settings.quantity import Quantity
from us_sim.settings.text_files import read_text
from us_sim.tissue.identification.observations import Seen
from us_sim.tissue.identification.pose_choice import ChosenPoses
from us_sim.tissue.identification.press_model import SeenPoints
from us_sim.tissue.identification.press_record import PressRecord
from us_sim.tissue.mesh.point_location import locate
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_COLUMNS = ("name", "time", "x", "y", "z")
_TIME, _LENGTH = Quantity("time", -1e6, 1e6), Quantity("length", -10.0, 10.0)
_OUTSIDE = 1e-3
"""m, that a point may lie outside the mesh."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """L points at rest, and S sights of them."""

    names: tuple[str, ...]  # L
    rest: NDArray[np.float64]  # (L, 3) m, frame patient
    which: NDArray[np.intp]  # (S,) of the points
    times: NDArray[np.float64]  # (S,) s, since the first pose of the recording
    places: NDArray[np.float64]  # (S, 3) m, frame patient

    def at(
        self, record: PressRecord, chosen: ChosenPoses, mesh: TetrahedralMesh, tolerance: float
    ) -> tuple[ChosenPoses, Seen, SeenPoints]:
        """The sights with the poses that they were had at, which are looked at as well.

        Raises:
            StiffnessError: there is no pose at the time of one, or a point is outside the mesh.
        """
        located = locate(mesh, self.rest)
        for name, outside in zip(self.names, located.outside, strict=True):
            if outside > _OUTSIDE:
                raise StiffnessError(
                    f"landmark {name} lies {1e3 * outside:.1f} mm outside the tissue's mesh: give "
                    f"places at rest in frame patient"
                )
        nearest = np.abs(record.times[:, None] - self.times).argmin(axis=0)
        for name, time, pose in zip(self.which, self.times, nearest, strict=True):
            if abs(record.times[pose] - time) > tolerance:
                raise StiffnessError(
                    f"landmark {self.names[name]} was seen at {time:g} s, and no pose with a "
                    f"wrench is within {1e3 * tolerance:g} ms of that"
                )
        pressing = chosen.clearance[nearest] < 0.0
        nearest = nearest[pressing]
        if len(nearest) == 0:
            raise StiffnessError("no landmark was seen while the probe pressed the tissue")
        pressed = np.union1d(chosen.pressed, nearest)
        poses, which = np.searchsorted(pressed, nearest), self.which[pressing]
        seen = Seen(self.places[pressing], poses, self.times[pressing])
        points = SeenPoints(
            poses,
            self.rest[which],
            mesh.tetrahedra[located.tetrahedra[which]],
            located.weights[which],
        )
        return replace(chosen, pressed=pressed), seen, points


def read_landmarks(file: str | Path) -> Landmarks:
    """The landmarks of a CSV.

    Raises:
        StiffnessError: it cannot be read, a column is missing, a cell is no such quantity, or a
            point has no place at rest, or is never seen.
    """
    file = Path(file)
    rest: dict[str, list[float]] = {}
    sights: list[tuple[str, float, list[float]]] = []
    try:
        reader = csv.DictReader(io.StringIO(read_text(file, "utf-8-sig")), skipinitialspace=True)
        reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        missing = [name for name in _COLUMNS if name not in reader.fieldnames]
        if missing:
            raise StiffnessError(
                f"{file}: has no column {missing[0]}; its first line must be {','.join(_COLUMNS)}"
            )
        for row in reader:
            name, time = (row["name"] or "").strip(), (row["time"] or "").strip()
            try:
                place = [_LENGTH.parse((row[axis] or "").strip()) for axis in "xyz"]
                when = _TIME.parse(time) if time else None
            except ValueError as error:
                raise StiffnessError(f"{file}: line {reader.line_num}: {error}") from error
            if when is not None:
                sights.append((name, when, place))
            elif name in rest:
                raise StiffnessError(f"{file}: line {reader.line_num}: {name} is at rest twice")
            else:
                rest[name] = place
    except OSError as error:
        raise StiffnessError(f"{file}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise StiffnessError(f"{file}: is no CSV: {error}") from error
    for name, when, _ in sights:
        if name not in rest:
            raise StiffnessError(
                f"{file}: {name} is seen at {when:g} s, but no row without a time says where it is "
                f"at rest"
            )
    if not sights:
        raise StiffnessError(f"{file}: no row has a time, so that nothing was seen")
    names = tuple(rest)
    return Landmarks(
        names,
        np.array([rest[name] for name in names]),
        np.array([names.index(name) for name, _, _ in sights], dtype=np.intp),
        np.array([when for _, when, _ in sights]),
        np.array([place for _, _, place in sights]),
    )
