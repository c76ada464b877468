"""The residual of a moving tissue: its elastic forces against those of a frictionless probe.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.elastic_balance import ElasticBalance
>>> balance = ElasticBalance(rounding=1e-12)
>>> down = np.array([[0.0, 0.0, 1.0]])
>>> holding = np.array([[0.0, 0.1, 4.0], [0.1, 0.0, 0.0]])  # N, and the probe pushes node 0
>>> round(balance.residual(holding, np.array([0]), down), 4)
0.0354
>>> round(balance.residual(holding / 40, np.array([], int), down[:0]), 4)  # it is released
0.025
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.elasticity.springs import SpringNetwork
from us_sim.tissue.elasticity.volume_term import VolumeTerm


class ElasticBalance:
    """Residual of each frame of a run.

    It is the norm of the unbalanced elastic forces over the norm of the contact forces, or, without
    contact, over the largest such norm since rest. Inertia and damping do not count: it follows
    from the nodes alone and says how far the tissue is from where it would come to rest.

    Args:
        rounding: N, norm of the forces at rest that arise when coordinates are rounded.
    """

    def __init__(self, rounding: float) -> None:
        self._rounding = rounding
        self._heaviest = 0.0

    @classmethod
    def of(
        cls, springs: SpringNetwork, volume: VolumeTerm, nodes: NDArray[np.float64]
    ) -> ElasticBalance:
        """The balance of springs and volumes that are undeformed at nodes (N, 3) m."""
        stiffness = float(np.linalg.norm(springs.stiffness))
        if len(volume.tetrahedra):
            # A tetrahedron resists as a spring of its modulus and size.
            size = np.cbrt(volume.rest_volume)
            stiffness += float(np.linalg.norm((volume.element + volume.nodal) * size))
        return cls(4 * float(np.finfo(np.float64).eps * np.abs(nodes).max()) * stiffness)

    @property
    def heaviest(self) -> float:
        """N, largest norm of contact forces since the tissue was at rest."""
        return self._heaviest

    def forget(self) -> None:
        """Begin anew, since the tissue was put elsewhere: earlier loads no longer count."""
        self._heaviest = 0.0

    def residual(
        self,
        holding: NDArray[np.float64],
        touched: NDArray[np.integer],
        normal: NDArray[np.float64],
    ) -> float:
        """The residual of one frame.

        Args:
            holding: (N, 3) N that would hold the nodes where they are, nothing at fixed ones.
            touched: (K,) nodes that the probe pushes.
            normal: (K, 3) unit directions in which it pushes them where they are.
        """
        push = np.maximum(np.einsum("ij,ij->i", holding[touched], normal), 0.0)
        unbalanced = holding.copy()
        unbalanced[touched] -= push[:, None] * normal
        imbalance, load = float(np.linalg.norm(unbalanced)), float(np.linalg.norm(push))
        if load == 0.0 and imbalance <= self._rounding:
            self._heaviest = 0.0
            return 0.0
        self._heaviest = max(self._heaviest, load) or imbalance
        return imbalance / (load or self._heaviest)
