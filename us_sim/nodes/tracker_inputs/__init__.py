"""What the probe tracker listens to: one file for each source that a scene may name."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from us_sim.nodes.probe_tracker import ProbeTracker

__all__ = ["INPUTS", "create_input"]

INPUTS = {
    "camera": "us_sim.nodes.tracker_inputs.camera_input:CameraInput",
    "haptic": "us_sim.nodes.tracker_inputs.haptic_input:HapticInput",
    "openigtlink": "us_sim.nodes.tracker_inputs.openigtlink_input:OpenIGTLinkInput",
    "path": "us_sim.nodes.tracker_inputs.path_input:PathInput",
    "pose": "us_sim.nodes.tracker_inputs.pose_input:PoseInput",
    "pose_array": "us_sim.nodes.tracker_inputs.pose_array_input:PoseArrayInput",
    "six_dof_mouse": "us_sim.nodes.tracker_inputs.six_dof_mouse_input:SixDofMouseInput",
    "tf": "us_sim.nodes.tracker_inputs.tf_input:TfInput",
}
"""Where each source's input is; its module is imported only when a scene names it."""


def create_input(source: str, node: ProbeTracker) -> Any:
    """The input that hands ``node`` the measurements of a source.

    Raises:
        UsSimError: the scene lacks what the source needs, or a library for it is missing.
    """
    module, _, name = INPUTS[source].partition(":")
    return getattr(importlib.import_module(module), name)(node)
