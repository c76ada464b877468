"""Topics made from the frames of a scanner, each a file, for those who subscribe.

Only those are there that a scene and its volume can provide.
"""

from __future__ import annotations

from us_sim.nodes.frame_streams.b_mode_stream import BModeStream
from us_sim.nodes.frame_streams.m_mode_stream import MModeStream
from us_sim.nodes.frame_streams.stream import FrameStream
from us_sim.nodes.scene_node import SceneNode
from us_sim.volume.volume import Volume

__all__ = ["FrameStream", "frame_streams"]


def frame_streams(node: SceneNode, volume: Volume) -> list[FrameStream]:
    """All that can be made of the frames of the node's scene, in the order of making."""
    streams: list[FrameStream] = [BModeStream(node)]
    if volume.labels is not None:
        from us_sim.nodes.frame_streams.label_stream import LabelStream

        streams.append(LabelStream(node))
    if node.scene.tissue is not None:
        from us_sim.nodes.frame_streams.displacement_stream import DisplacementStream
        from us_sim.nodes.frame_streams.strain_streams import strain_streams

        streams += [DisplacementStream(node), *strain_streams(node)]
    if node.scene.flows:
        from us_sim.nodes.frame_streams.doppler_streams import doppler_streams

        streams += doppler_streams(node, volume)
    return [*streams, MModeStream(node)]
