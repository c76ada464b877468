"""The program that runs fTetWild (Hu et al., ACM Trans Graph 39:117, 2020) on a soup of triangles.

It is a process of its own, as native code may crash or run on for ever on surfaces nobody chose.

    python wild_mesher.py IN.npz OUT.npz
"""

from __future__ import annotations

import sys
import types

import numpy as np

_ROUNDS = 10  # Of optimization; further ones hardly better a mesh


def main(given: str, made: str) -> None:
    """Read vertices, triangles, sizes and settings; write nodes and tetrahedra."""
    try:
        import pyvista  # noqa: F401
    except ImportError:
        # pytetwild imports it for shortcuts of its own, which nothing here needs.
        sys.modules["pyvista"] = types.ModuleType("pyvista")
    from pytetwild import tetrahedralize

    with np.load(given, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    nodes, tetrahedra = tetrahedralize(
        arrays["vertices"],
        arrays["triangles"],
        edge_length_abs=float(arrays["edge"]),
        epsilon=float(arrays["epsilon"]),
        bg_vertices=arrays["size_nodes"],
        bg_tets=arrays["size_tetrahedra"],
        bg_values=arrays["sizes"],
        coarsen=bool(arrays["coarsen"]),
        num_opt_iter=_ROUNDS,
        num_threads=1,  # cores are for others
        disable_filtering=True,
        vtk_ordering=True,
    )
    np.savez(made, nodes=nodes, tetrahedra=tetrahedra)


if __name__ == "__main__":
    main(*sys.argv[1:3])
