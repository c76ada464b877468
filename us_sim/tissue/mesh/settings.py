"""The settings of the tissue's mesh in a scene, which every node reads: no numba is needed here."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from types import MappingProxyType

from us_sim.errors import MeshError
from us_sim.geometry.pose import PLACE, Placement
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

# Boxes of cells between planes, and boxes of tetrahedra whose faces follow the structures.
KINDS = ("grid", "conforming")
_LEAST_NODES = 64
_MOST_ALONG = 400


@dataclass(frozen=True)
class MeshSettings(Settings):
    """A box of tetrahedra in ``patient``, or a mesh from a file."""

    section = "mesh"
    error = MeshError
    alternatives = MappingProxyType(
        {"file": ("unit", "pose", "margin"), "lower": ("upper", "nodes", "planes", "kind")}
    )

    lower: tuple[float, float, float] | None = setting(
        PLACE, "corner of the box with the least x, y, z", default=None
    )
    upper: tuple[float, float, float] | None = setting(
        PLACE, "corner of the box with the largest x, y, z", default=None
    )
    nodes: tuple[int, int, int] | int = setting(
        Quantity("number", 2, 200_000),
        "of the box along x, y, z; or how many it has at most, which are put close together under "
        "the probe and where structures are thin",
        default=(20, 10, 10),
    )
    planes: dict[str, tuple[float, ...]] = setting(
        PLACE,
        "coordinates of the box's nodes along x, y or z one by one, to put them where they count",
        default_factory=dict,
    )
    kind: str = setting(
        description="of the box: cells between planes, or tetrahedra whose faces follow the "
        "structures' surfaces, which needs the extra `conforming` and one number of `nodes`",
        choices=KINDS,
        default="grid",
    )
    file: str | None = setting(
        description="mesh in place of the box: Gmsh, VTK, or what else meshio reads",
        default=None,
        file=True,
    )
    unit: float = setting(
        Quantity("length", 1e-9, 1e3), "length of a unit of the file", default=1.0
    )
    pose: Placement = setting(description="of the file's frame in `patient`", default=Placement())
    margin: float | None = setting(
        Quantity("length", 1e-6, 1.0),
        "how near to a face of the file's bounding box a boundary node belongs to that face; not "
        "given: a twentieth of the size along that axis",
        default=None,
    )

    def check(self) -> None:
        """A file, or a box whose corners and planes go together."""
        box: dict[str, object] = {"lower": self.lower, "upper": self.upper}
        box |= {"planes": self.planes or None, "kind": self.kind if self.kind != "grid" else None}
        if self.file is not None:
            for key, value in box.items():
                if value is not None:
                    raise self.refused("", f"has both `file` and `{key}`; keep one")
            return
        if self.lower is None or self.upper is None:
            raise self.refused(
                "lower" if self.lower is None else "upper",
                "is missing; give the corners of a box, or a `file`",
            )
        if self.unit != 1.0 or self.pose != Placement() or self.margin is not None:
            raise self.refused("", "`unit`, `pose` and `margin` are for a mesh from a `file` only")
        if self.kind != "grid" and not isinstance(self.nodes, int):
            raise self.refused(
                "nodes",
                f"must be one number, how many there are at most, where kind is {self.kind}",
            )
        if isinstance(self.nodes, int):
            if self.planes:
                raise self.refused(
                    "nodes", "must be three numbers where `planes` say where the nodes are"
                )
            if self.nodes < _LEAST_NODES:
                raise self.refused(
                    "nodes", f"{self.nodes} make no box: give {_LEAST_NODES} or more"
                )
        elif max(self.nodes) > _MOST_ALONG:
            raise self.refused(
                f"nodes[{self.nodes.index(max(self.nodes))}]",
                f"{max(self.nodes)} is outside 2 to {_MOST_ALONG}",
            )
        for name in self.planes:
            if name not in ("x", "y", "z"):
                raise self.refused("planes", f"unknown axis `{name}`; axes are x, y and z")
        for axis, name in enumerate("xyz"):
            lower, upper = self.lower[axis], self.upper[axis]
            if lower >= upper:
                raise self.refused(
                    f"upper[{axis}]",
                    f"{upper:g} m is not above tissue.mesh.lower[{axis}], {lower:g} m",
                )
            if name in self.planes and not isinstance(self.nodes, int):
                self._check_planes(name, self.planes[name], lower, upper, self.nodes[axis])

    def _check_planes(
        self, axis: str, planes: tuple[float, ...], lower: float, upper: float, count: int
    ) -> None:
        if len(planes) < 2 or any(b <= a for a, b in itertools.pairwise(planes)):
            raise self.refused(f"planes.{axis}", "needs two or more rising coordinates")
        ends = zip((planes[0], planes[-1]), (lower, upper), strict=True)
        if len(planes) != count or not all(math.isclose(a, b, abs_tol=1e-9) for a, b in ends):
            raise self.refused(
                f"planes.{axis}",
                f"must be {count} coordinates from {lower:g} to {upper:g} m, as nodes, lower and "
                f"upper say",
            )
