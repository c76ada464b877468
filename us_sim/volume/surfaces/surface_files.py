"""Surfaces into files: STL, PLY and OBJ, in millimetres on DICOM's axes.

Each says in its header that its axes are left, posterior and superior (``SPACE=LPS``), which
3D Slicer looks for and other programs skip.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.partial_file import partial_file
from us_sim.volume.surfaces.closed_surface import ClosedSurface
from us_sim.volume.surfaces.settings import SURFACE_FORMATS

_SAID = "us_sim; millimetres; SPACE=LPS"


def write_surface(path: Path, surface: ClosedSurface) -> None:
    """Write a surface to a file; one of that name is replaced, at once or not at all.

    Raises:
        VolumeError: the name ends in none of `SURFACE_FORMATS`, or the file cannot be written.
    """
    written = _WRITERS.get(path.suffix.lower())
    if written is None:
        raise VolumeError(f"{path}: a surface file ends in .{', .'.join(SURFACE_FORMATS)}")
    with partial_file(path) as partial:
        partial.write_bytes(written(surface.vertices * 1e3, surface.triangles))


def _stl(points: NDArray[np.float64], triangles: NDArray[np.int32]) -> bytes:
    """Binary STL: 80 bytes of header, and 50 for each triangle."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    facets = np.zeros(len(triangles), record)
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facets["normal"] = np.divide(normals, lengths, where=lengths > 0, out=np.zeros_like(normals))
    facets["corners"] = corners
    header = _SAID.encode().ljust(80)
    return header + np.uint32(len(triangles)).astype("<u4").tobytes() + facets.tobytes()


def _ply(points: NDArray[np.float64], triangles: NDArray[np.int32]) -> bytes:
    """Binary PLY, little-endian (paulbourke.net/dataformats/ply)."""
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {_SAID}\n"
        f"element vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.zeros(len(triangles), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, triangles
    return header.encode() + points.astype("<f4").tobytes() + faces.tobytes()


def _obj(points: NDArray[np.float64], triangles: NDArray[np.int32]) -> bytes:
    """Wavefront's text, whose indices begin at 1."""
    lines = [f"# {_SAID}"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in points.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist()]
    return ("\n".join(lines) + "\n").encode()


_WRITERS = {".stl": _stl, ".ply": _ply, ".obj": _obj}
