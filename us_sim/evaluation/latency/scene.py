"""The scene file of a case: the arm, with another mesh, method or image."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from us_sim.evaluation.latency.cases import COARSE, Case
from us_sim.scene.reading import load_scene

_ARM = "upper_arm"


def write_scene(case: Case, folder: Path) -> Path:
    """Write ``scene.yaml`` to a folder, and return it."""
    tissue: dict[str, object] = {"solver": case.solver}
    if case.mesh != COARSE:
        tissue["mesh"] = {"nodes": list(case.mesh), "planes": _planes(case.mesh)}
    document = {
        "name": "latency",
        "based_on": _ARM,
        "probe": {"image": list(case.image)},
        "tissue": tissue,
    }
    file = folder / "scene.yaml"
    file.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    return file


def _planes(counts: tuple[int, int, int]) -> dict[str, list[float]]:
    """m, more planes of nodes than the arm has, as close together as there."""
    arm = load_scene(_ARM)
    assert arm.tissue is not None
    planes = {}
    for axis, count in zip("xyz", counts, strict=True):
        own = arm.tissue.mesh.planes.get(axis)
        if own is not None:
            places = np.linspace(0, len(own) - 1, count)
            planes[axis] = np.interp(places, np.arange(len(own)), own).round(6).tolist()
    return planes
