"""The box of tetrahedra of a scene's tissue, with its planes where they count.

>>> from us_sim.geometry.collider import RoundedBox
>>> from us_sim.scene.tissue_box import footprint
>>> footprint(RoundedBox(length=0.046, width=0.014, height=0.04, rounding=0.004))
(0.023, 0.007)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Capsule, Collider, Sphere
from us_sim.scene.scene import Scene
from us_sim.settings.registry import COLLIDERS
from us_sim.tissue.elasticity.material import LAYERS, kind_of
from us_sim.tissue.mesh.box_planes import fitted_planes, wanted_by_labels, wanted_under_probe
from us_sim.volume.volume import Volume

_STEPS = 160
"""Places along the longest side of the box at which structures are looked for."""

_IN_REACH = 0.015
"""m: how far from the image's plane at rest structures count; the probe slides and tilts."""


def footprint(collider: Collider) -> tuple[float, float]:
    """Half the length and half the width (m, along the probe's x and y) of what presses."""
    if isinstance(collider, Sphere):
        return collider.radius, collider.radius
    if isinstance(collider, Capsule):
        return collider.length / 2 + collider.radius, collider.radius
    return collider.length / 2, collider.width / 2


def box_planes(
    scene: Scene, volume: Volume
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mesh planes (m) along x, y, z of a box that may have so many nodes as the scene says.

    Raises:
        MeshError: they are too few.
    """
    assert scene.tissue is not None
    assert scene.probe.collider is not None
    given = scene.tissue.mesh
    assert isinstance(given.nodes, int)
    box = np.array([given.lower, given.upper])
    step = float((box[1] - box[0]).max()) / _STEPS
    counted = [label for label, name in volume.label_names.items() if counts(scene, name)]
    labels = volume.labels
    if labels is None:
        labels, counted = np.zeros((1, 1, 1), np.uint8), []
    wanted = wanted_by_labels(
        labels, volume.patient_to_index, box, step, counted=counted, aside=_IN_REACH
    )
    pressed = footprint(scene.probe.collider.settings(COLLIDERS))
    return fitted_planes(wanted_under_probe(wanted, *pressed), given.nodes)


def counts(scene: Scene, label: str) -> bool:
    """Whether planes are put close together for a label: not for what is held, nor for layers."""
    assert scene.tissue is not None
    named = {given.label or name for name, given in scene.structures.items()}
    return label in named and label not in scene.tissue.fixed and kind_of(label) not in LAYERS
