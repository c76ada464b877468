"""What a sonographer sets of the images that a node makes, as parameters that may change."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import is_live
from us_sim.scene.building import probe_of
from us_sim.settings.setting import rules_of
from us_sim.slicing.acoustics.settings import Acoustics, SoundSettings
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import Imaging

_TISSUES = "acoustics.tissues."

Console = Callable[[Probe, Imaging, Acoustics], None]


class ScannerConsole:
    """The probe's live settings, those of image formation, and those of sound, also by tissue.

    Args:
        node: that gets the parameters.
        prepare: called with them before a change is taken; what it raises refuses it.
        use: called with them when parameters have been set.
    """

    def __init__(self, node: SceneNode, prepare: Console, use: Console) -> None:
        probe, imaging = probe_of(node.scene), node.scene.imaging
        live = [name for name in rules_of(type(probe)) if is_live(type(probe), name)]
        groups = {
            "probe": Group(probe, names=live),
            "imaging": Group(imaging, names=rules_of(Imaging)),
            "acoustics": Group(imaging.acoustics, "acoustics.", rules_of(SoundSettings)),
        }
        for label, tissue in imaging.acoustics.tissues.items():
            groups[_TISSUES + label] = Group(tissue, f"{_TISSUES}{label}.")
        console = LiveSettings(
            node, groups, lambda to: prepare(*_together(to)), lambda to: use(*_together(to))
        )
        self.values = _together(console.values)


def _together(values: dict[str, Any]) -> tuple[Probe, Imaging, Acoustics]:
    tissues = {
        key.removeprefix(_TISSUES): value
        for key, value in values.items()
        if key.startswith(_TISSUES)
    }
    acoustics = dataclasses.replace(values["acoustics"], tissues=tissues)
    return values["probe"], values["imaging"], acoustics
