"""Topics made from the frames of a scanner, each a file, for those who subscribe.

Only those are there that a scene and its volume can provide.
"""

from __future__ import annotations

from us_sim.nodes.frame_streams.b_mode_stream import BModeStream
from us_sim.nodes.frame_streams.m_mode_stream import MModeStream
from us_sim.nodes.frame_streams.stream import FrameStream
from us_sim.nodes.scene_node import SceneNode
from us_sim.slicing.probe.probe import Probe
from us_sim.volume.volume import Volume

__all__ = ["FrameStream", "frame_streams"]


def frame_streams(node: SceneNode, volume: Volume, probe: Probe) -> list[FrameStream]:
    """All that can be made of the frames of the node's scene, in the order of making; prepared.

    Raises:
        UsSimError: one of them cannot be used with this probe, or a flow with its structure.
    """
    further: list[FrameStream] = []
    if volume.labels is not None:
        from us_sim.nodes.frame_streams.label_stream import LabelStream

        further.append(LabelStream(node))
    if node.scene.tissue is not None:
        from us_sim.nodes.frame_streams.displacement_stream import DisplacementStream
        from us_sim.nodes.frame_streams.strain_streams import strain_streams

        further += [DisplacementStream(node), *strain_streams(node)]
    if node.scene.flows:
        from us_sim.nodes.frame_streams.doppler_streams import doppler_streams

        further += doppler_streams(node, volume)
    further.append(MModeStream(node))
    for stream in further:
        stream.prepare(probe)
    # Whoever waits for the images may begin when their topic is there, so it comes last.
    return [BModeStream(node), *further]
