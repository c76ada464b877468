"""Topics of moving blood, where a scene names flows; all of the same blood."""

from __future__ import annotations

from typing import Any

from us_sim.nodes.frame_streams.colour_stream import ColourStream
from us_sim.nodes.frame_streams.spectrum_stream import SpectrumStream
from us_sim.nodes.frame_streams.stream import FrameStream
from us_sim.nodes.frame_streams.velocity_stream import VelocityStream
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.scene.building import blood_of
from us_sim.slicing.flow.warm_up import warm_up
from us_sim.volume.volume import Volume


def doppler_streams(node: SceneNode, volume: Volume) -> list[FrameStream]:
    """The velocity of blood, its colour Doppler and its spectrum; flows are parameters of the node.

    Raises:
        SceneError: a structure with a flow is no tube, or its flow leads across it.
    """
    warm_up()
    blood = blood_of(node.scene, volume)
    vessels = dict(zip(node.scene.flows, blood.vessels, strict=True))

    def require(wanted: dict[str, Any]) -> None:
        for name, settings in wanted.items():
            vessels[name].require(settings)

    def use(wanted: dict[str, Any]) -> None:
        for name, settings in wanted.items():
            if settings != vessels[name].settings:
                vessels[name].use(settings)

    given = {name: Group(flow, f"flow.{name}.") for name, flow in node.scene.flows.items()}
    flows = LiveSettings(node, given, require, use)
    use(flows.values)
    colour = ColourStream(node, blood)
    return [VelocityStream(node, colour), colour, SpectrumStream(node, blood)]
