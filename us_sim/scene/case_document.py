"""From a case to a scene: what a scene file would say to scan it and press on it.

Frame ``patient`` is the probe's where it touches the skin at the case's start: its origin is the
middle of the probe's face, and +z goes into the body.

>>> import numpy as np
>>> from us_sim.geometry.pose import Placement
>>> from us_sim.scene.case_document import patient_from_volume
>>> start = Placement((0.0, 0.1, 0.0), (1.0, 0.0, 0.0, 0.0))  # on the volume's face, looking back
>>> pose = patient_from_volume(start).pose
>>> bool(np.allclose(pose.apply(np.array([[0.0, 0.1, -0.03]])), [[0.0, 0.0, 0.03]]))
True
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Placement, Pose
from us_sim.geometry.transducer import ProbeSettings
from us_sim.scene.tissue_box import footprint
from us_sim.settings.registry import COLLIDERS, PROBES
from us_sim.settings.writing import document_of
from us_sim.volume.cases.case import Case, read_case
from us_sim.volume.cases.settings import AROUND, SLIDE, CaseSettings
from us_sim.volume.volume import grid_extent

_BESIDE = 0.013  # m, of tissue beside the probe
_LEAST_ASIDE = 0.03  # m, along the probe's y: for its slide, and for tissue to give way
_ASIDE_OVER_DEPTH = 0.25
_BELOW = 1.05
"""Depth of the tissue over that of the image: tissue that moves against the volume beside it would
leave a seam in the image."""
_PRESS_OVER_DEPTH = 1 / 3
_DEEPEST_PRESS = 0.022  # m, of a firm press on an abdomen
_THINNEST = 0.02  # m, to which the tissue is cut where the volume ends


def case_document(folder: Path) -> dict[str, Any]:
    """The keys of a scene made from the case in a folder.

    Raises:
        CaseError, VolumeError: the case cannot be read.
    """
    case = read_case(folder)
    settings = case.settings
    if settings.start is None or settings.probe is None or settings.probe.collider is None:
        from us_sim.volume.cases.proposal import with_proposal

        settings = with_proposal(settings, case.volume())
    assert settings.start is not None
    assert settings.probe is not None
    names = [AROUND, *settings.structures] if case.has_labels else [AROUND]
    held = [name for name in settings.held if case.has_labels or name not in settings.structures]
    pose = patient_from_volume(settings.start)
    document: dict[str, Any] = {
        "name": settings.name,
        "volume": {"case": str(case.folder), "pose": document_of(pose)},
        "probe": document_of(settings.probe),
        "imaging": {"contact": True},
        "tissue": {
            "solver": "fem_nonlinear",
            "mesh": _mesh(case, settings.probe, pose),
            "fixed": held,
            "materials": {name: document_of(settings.material_of(name)) for name in names},
        },
        "path": _path(settings),
    }
    if settings.description:
        document["description"] = settings.description
    if case.has_labels and settings.structures:
        document["structures"] = {
            name: {"colour": list(settings.colour_of(name))} for name in settings.structures
        }
    return document


def _path(settings: CaseSettings) -> str:
    """The path of a press as deep as the case proposes."""
    assert settings.probe is not None
    press = settings.press
    if press is None:
        depth = settings.probe.array.settings(PROBES).depth
        press = min(_PRESS_OVER_DEPTH * depth, _DEEPEST_PRESS)
    from us_sim.recording.press_and_slide import pressing_path

    return str(pressing_path(press, SLIDE if settings.slide is None else settings.slide))


def patient_from_volume(start: Placement) -> Placement:
    """The pose of the volume's own frame in that of a probe at ``start``."""
    pose: Pose = start.pose.inverse()
    return Placement(tuple(pose.position.tolist()), tuple(pose.orientation.tolist()))


def _mesh(case: Case, probe: ProbeSettings, pose: Placement) -> dict[str, Any]:
    """The box of tissue: as wide and deep as the image, as far as the volume goes."""
    matrix, shape = case.placement()
    volume = grid_extent(pose.pose.matrix @ matrix, shape)
    array = probe.array.settings(PROBES)
    length, width = footprint(probe.collider.settings(COLLIDERS)) if probe.collider else (0.0, 0.0)
    aside = max(array.width / 2, length + _BESIDE)
    across = max(_LEAST_ASIDE, _ASIDE_OVER_DEPTH * array.depth, 2 * width)
    box = np.array([[-aside, -across, 0.0], [aside, across, _BELOW * array.depth]])
    cut = np.stack([np.maximum(box[0], volume[0]), np.minimum(box[1], volume[1])])
    cut[0, 2] = 0.0
    thin = cut[1] - cut[0] < _THINNEST
    box = np.where(thin, box, cut)
    document: dict[str, Any] = {"lower": _rounded(box[0]), "upper": _rounded(box[1])}
    if case.settings.mesh != "grid":
        document["kind"] = case.settings.mesh
    return document | {"nodes": case.settings.nodes}


def _rounded(corner: NDArray[np.float64]) -> list[float]:
    """To a tenth of a millimetre, for a person who reads the scene."""
    return [round(float(value), 4) for value in corner]
