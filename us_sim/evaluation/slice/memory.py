"""The memory that images of a large volume take, in a process of its own.

Run as `python -m us_sim.evaluation.slice.memory SIDE`, it cuts images of a volume of SIDE voxels
along each axis and prints the most bytes that the process ever held.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from us_sim.evaluation.own_process import start_module


def peak_memory(side: int) -> int | None:
    """Bytes that a process held at most that cut a volume of ``side``³ uint8 voxels.

    They include the volume, Python and every library. None where the system does not tell.
    """
    said, _ = start_module("us_sim.evaluation.slice.memory", str(side)).communicate()
    return int(said) if said.strip().isdigit() else None


def _cut(side: int) -> None:
    from us_sim.evaluation.slice.cases import MAIN
    from us_sim.slicing.cutting.slicer import create_slicer
    from us_sim.volume.volume import Volume

    voxels = np.random.default_rng(1).integers(0, 256, (side,) * 3, dtype=np.uint8)
    placed = np.diag([0.21 / side, 0.11 / side, 0.11 / side, 1.0])
    placed[:3, 3] = -0.105, -0.055, -0.005
    mesh = MAIN.mesh()
    slicer = create_slicer(
        "scan_conversion", Volume(voxels, placed), mesh.nodes, mesh.tetrahedra, threads=2
    )
    for frame in MAIN.frames(8):
        slicer.image(frame.nodes, frame.plane)


def _peak() -> int | None:
    """Bytes that this process held at most; Linux counts a parent's pages in ``ru_maxrss``."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes, on macOS


if __name__ == "__main__":
    _cut(int(sys.argv[1]))
    print(_peak() or "")
