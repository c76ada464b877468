"""Surfaces into STL files, in millimetres on DICOM's axes.

The header says that the axes are left, posterior and superior (``SPACE=LPS``), which 3D Slicer
looks for and other programs skip; meshio writes no such header.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from us_sim.volume.partial_file import partial_file
from us_sim.volume.surfaces.closed_surface import ClosedSurface

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_stl(path: Path, surface: ClosedSurface) -> None:
    """Write a surface to a binary file; one of that name is replaced, at once or not at all.

    Raises:
        VolumeError: the file cannot be written.
    """
    facets = np.zeros(len(surface.triangles), _FACET)
    lengths = np.linalg.norm(surface.crosses, axis=1, keepdims=True)
    facets["normal"] = surface.crosses / np.maximum(lengths, 1e-30)
    facets["corners"] = 1e3 * surface.vertices[surface.triangles]
    header = b"us_sim; millimetres; SPACE=LPS".ljust(80)
    with partial_file(path) as partial:
        partial.write_bytes(header + np.uint32(len(facets)).tobytes() + facets.tobytes())
