"""Tetrahedra turned inside out, which springs do not resist.

Springs know lengths and not volumes: pressed beyond the mesh's spacing, a node can pass through a
face and then rests on the wrong side. Under the probe this is only reported; without a probe the
tissue is put back to its undeformed state, which is then the state of rest.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.tangling import count_inverted
>>> corner = np.vstack([np.zeros(3), np.eye(3)])
>>> one = np.array([[0, 1, 2, 3]], dtype=np.int32)
>>> count_inverted(corner, one), count_inverted(corner * [1.0, 1.0, -1.0], one)
(0, 1)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.settings.spelling import counted
from us_sim.tissue.elasticity.volume_term import area_vectors
from us_sim.tissue.model import TissueModel

_WATCHED, _LAYERS = 50_000, 2
"""Tetrahedra up to which all are watched, which takes less than a millisecond; and how many layers
under the surface are watched otherwise."""

_PATIENCE = 10
"""Frames in which a released tissue may untangle by itself."""


class Tangling:
    """Watches a tissue for tetrahedra inside out, frame by frame.

    Args:
        model: of the tissue.
    """

    def __init__(self, model: TissueModel) -> None:
        self._tetrahedra = model.mesh.tetrahedra
        self._held = bool(model.fixed.any())
        self._frames_free = 0

    def forget(self) -> None:
        """Begin anew, since the tissue was put elsewhere."""
        self._frames_free = 0

    def judge(self, positions: NDArray[np.float64], touched: bool) -> tuple[str, bool]:
        """What to say at the end of a frame, and whether the tissue is to be put back to rest.

        Args:
            positions: (N, 3) m.
            touched: whether the probe pushes the tissue.
        """
        self._frames_free = 0 if touched else self._frames_free + 1
        inverted = count_inverted(positions, self._tetrahedra)
        if inverted == 0:
            return "", False
        if self._frames_free < _PATIENCE or not self._held:
            return f"{counted(inverted, 'tetrahedron is', 'tetrahedra are')} inside out", False
        return (
            f"{counted(inverted, 'tetrahedron', 'tetrahedra')} stayed inside out, so the tissue "
            f"was put back to rest",
            True,
        )


def watched_tetrahedra(model: TissueModel) -> NDArray[np.int32]:
    """(W, 4), where a press turns tetrahedra inside out first: all, or those under the surface."""
    tetrahedra = model.mesh.tetrahedra
    if len(tetrahedra) <= _WATCHED:
        return tetrahedra
    near = np.zeros(len(model.mesh.nodes), dtype=bool)
    near[model.contact_nodes] = True
    for _ in range(_LAYERS):
        touched = near[tetrahedra].any(axis=1)
        near[tetrahedra[touched]] = True
    return np.ascontiguousarray(tetrahedra[touched])


@njit(cache=True, nogil=True, error_model="numpy")
def count_inverted(nodes, tetrahedra):
    """How many tetrahedra (M, 4) have no positive volume."""
    count = 0
    for t in range(len(tetrahedra)):
        if not area_vectors(nodes, tetrahedra, t)[0] > 0.0:
            count += 1
    return count
