"""A transducer as it goes to a page: its parts, and the outline of its image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.viewer.meshes.coloured_surface import ColouredSurface
from us_sim.viewer.packet import Packet


def transducer_packet(
    kind: str,
    sequence: int,
    parts: Sequence[ColouredSurface],
    outline: NDArray[np.floating],
) -> Packet:
    """Vertices as float32 and triangles as uint32 of each part, then the outline as float32.

    Args:
        parts: in frame ``probe``.
        outline: (P, 3) m, as of `us_sim.slicing.probe.probe.image_outline`.
    """
    header = {
        "parts": [
            {
                "name": part.name,
                "colour": list(part.colour),
                "vertices": len(part.vertices),
                "triangles": len(part.triangles),
            }
            for part in parts
        ],
        "outline": len(outline),
    }
    arrays: list[NDArray[np.generic]] = []
    for part in parts:
        arrays += [part.vertices.astype(np.float32), part.triangles.astype(np.uint32)]
    arrays.append(outline.astype(np.float32))
    payload = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return Packet(kind, sequence, header, payload)
