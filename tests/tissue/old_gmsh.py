"""Organ meshes in Gmsh's format 1, saved in one that meshio reads."""

from pathlib import Path

import meshio
import numpy as np


def as_vtu(path: Path, folder: Path) -> Path:
    """Save a mesh as a VTU file in a folder."""
    nodes, elements = path.read_text().split("$ENDNOD")
    table = np.array([row.split() for row in nodes.strip().splitlines()[2:]], float)
    rows = [row.split() for row in elements.strip().splitlines()[2:-1]]
    named = np.array([row[5:] for row in rows if row[1] == "4"], int)
    tetrahedra = np.searchsorted(table[:, 0], named)  # nodes are in the order of their numbers
    meshio.write(folder / f"{path.stem}.vtu", meshio.Mesh(table[:, 1:], [("tetra", tetrahedra)]))
    return folder / f"{path.stem}.vtu"
