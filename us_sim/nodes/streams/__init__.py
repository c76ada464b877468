"""Topics of images made from a scanner's frames, as far as scene and volume provide them."""

from __future__ import annotations

from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.streams.stream import IMAGE, FrameStream, create_m_mode_stream
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.strain import compute_displacement
from us_sim.volume.volume import Volume


def create_frame_streams(node: SceneNode, volume: Volume, probe: Probe) -> list[FrameStream]:
    """Create and prepare the streams that the node's scene can provide, in the order of drawing."""
    further: list[FrameStream] = []
    if volume.labels is not None:
        further.append(FrameStream(node, "ultrasound/labels", lambda frame: frame.labels))
    if node.scene.tissue is not None:
        from us_sim.nodes.streams.strain import create_strain_streams

        further.append(FrameStream(node, "ultrasound/displacement", compute_displacement))
        further += create_strain_streams(node)
    if node.scene.flows:
        from us_sim.nodes.streams.doppler import create_doppler_streams

        further += create_doppler_streams(node, volume)
    further.append(create_m_mode_stream(node))
    for stream in further:
        stream.prepare(probe)
    # A player that waits for the images begins when their topic is there, so it comes last.
    return [FrameStream(node, IMAGE, lambda frame: frame.pixels), *further]
