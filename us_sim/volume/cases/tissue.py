"""The tissue of a case: ``tissue.npz``, its mesh and how much of each label is in each tetrahedron.

It says what it was made from, and is made anew when that has changed.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CaseError, MeshError
from us_sim.tissue.elasticity.materials import LabelFractions
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.volume.partial_file import partial_file

_ARRAYS = ("nodes", "tetrahedra", "labels", "fractions", "made_from")
_PLANES = ("planes_x", "planes_y", "planes_z")


@dataclass(frozen=True, eq=False)
class CaseTissue:
    """A mesh in frame ``patient``, and the labels in it."""

    mesh: TetrahedralMesh
    labels: NDArray[np.uint8]  # (L,) those that occur in it, ascending
    fractions: NDArray[np.float64]  # (M, L) of each tetrahedron's volume
    made_from: Mapping[str, Any]  # settings and checksums, as JSON holds them

    @property
    def label_fractions(self) -> LabelFractions:
        """How much of each tetrahedron each label fills."""
        return LabelFractions(self.labels, self.fractions)


def write_tissue(path: Path, tissue: CaseTissue) -> None:
    """Write ``tissue.npz``; a file of that name is replaced by the whole new one.

    Raises:
        CaseError: it cannot be written.
    """
    arrays: dict[str, Any] = {
        "nodes": tissue.mesh.nodes,
        "tetrahedra": tissue.mesh.tetrahedra,
        "labels": tissue.labels,
        "fractions": tissue.fractions.astype(np.float32),
        "made_from": np.array(json.dumps(tissue.made_from, sort_keys=True)),
    }
    if tissue.mesh.planes is not None:
        arrays |= dict(zip(_PLANES, tissue.mesh.planes, strict=True))
    with partial_file(path, error_type=CaseError) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)


def read_tissue(path: Path) -> CaseTissue:
    """Read ``tissue.npz``.

    Raises:
        CaseError: it cannot be read, or holds something else.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        nodes, tetrahedra, labels, fractions, made_from = (arrays[name] for name in _ARRAYS)
        planes = None
        if _PLANES[0] in arrays:
            planes = tuple(arrays[name].astype(np.float64) for name in _PLANES)
        mesh = TetrahedralMesh(nodes.astype(np.float64), tetrahedra.astype(np.int32), planes)
        fractions = fractions.astype(np.float64).reshape(len(tetrahedra), len(labels))
        fractions /= fractions.sum(axis=1, keepdims=True)
        return CaseTissue(mesh, labels.astype(np.uint8), fractions, json.loads(str(made_from)))
    except (OSError, EOFError, LookupError, ValueError, BadZipFile, zlib.error, MeshError) as error:
        raise CaseError(f"{path}: is no tissue that us_sim wrote, or damaged; remove it") from error
