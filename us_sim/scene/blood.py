"""The blood in the vessels of a scene: each structure that has a flow, made from its label."""

from __future__ import annotations

from us_sim.errors import SceneError
from us_sim.scene.scene import Scene
from us_sim.scene.structures import require_labels
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.vessel import Vessel
from us_sim.volume.volume import Volume


def blood_of(scene: Scene, volume: Volume) -> Blood:
    """All vessels of a scene that have a flow.

    Args:
        volume: of the scene.

    Raises:
        SceneError: a structure with a flow is no tube, its flow leads across it, or the volume has
            no such label; one sentence with file and key.
    """
    require_labels(scene, volume)
    numbers = {name: label for label, name in volume.label_names.items()}
    vessels = []
    for name, flow in scene.flows.items():
        label = numbers[scene.structures[name].label or name]
        try:
            vessels.append(Vessel(f"structures.{name}", volume, label, flow))
        except SceneError as error:
            raise SceneError(f"{scene.origin}: {error}") from error
    return Blood(vessels)
