"""Viscous tissue in quasi-static form: overstress that relaxes while the deformation lasts.

One branch of a Prony series: beside the tissue's own energy there is that of a spring of g times
its stiffness K at rest, whose other end v follows the displacement u with a time constant,

    g/2 (u - v)' K (u - v),    dv/dt = (u - v) / time.

Where u changes evenly from frame to frame, h apart, the force at a frame's end is exactly

    g (1 - exp(-h / time)) time / h K (u - v),    v = exp(-h / time) v + (1 - exp(-h / time)) u

with v, u on the right those of the frame before (R. L. Taylor, K. S. Pister and G. L. Goudreau,
Thermomechanical analysis of viscoelastic solids, Int. J. Numer. Methods Eng. 2, 1970). Linear: what
turns as a whole is stressed until it has relaxed.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.elasticity.neo_hookean import NeoHookean
>>> from us_sim.tissue.elasticity.overstress import Overstress, PronyBranch
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> mesh = box_mesh(*[uniform_planes(0.0, 0.1, 3)] * 3)
>>> tissue = NeoHookean(mesh, uniform_material(mesh, Material(10e3, 0.3, 1000.0)), np.float64)
>>> overstress = Overstress(PronyBranch(0.5, relaxation_time=1.0, interval=0.1), tissue, tissue)
>>> stretched = 0.01 * mesh.nodes.T.copy()
>>> energy = overstress.energy(stretched)
>>> overstress.relax(stretched)  # by a tenth of the time constant
>>> bool(np.isclose(overstress.energy(stretched), np.exp(-0.2) * energy))
True
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.elasticity.neo_hookean import NeoHookean


@dataclass(frozen=True)
class PronyBranch:
    """A spring and a damper in series."""

    modulus: float  # of the spring, over the tissue's own
    relaxation_time: float  # s
    interval: float  # s, from frame to frame


class Overstress:
    """The energy of a tissue's branch, and what it remembers.

    Args:
        branch: its constants.
        tissue: in double precision, linearised at rest.
        single: the same in the precision of `add_product`.
    """

    def __init__(self, branch: PronyBranch, tissue: NeoHookean, single: NeoHookean) -> None:
        frames = branch.interval / branch.relaxation_time
        self._kept = math.exp(-frames)
        #: Stiffness within a frame, over the tissue's own at rest.
        self.stiffness = branch.modulus * -math.expm1(-frames) / frames
        self._tissue = tissue
        self._single = single
        self.relaxed = np.zeros((3, tissue.count))  # (3, N) m, v above
        self.load = 0.0  # N, norm of the forces when last added
        self._image = np.empty((3, tissue.count), single.dtype)

    def stiffened(self, field: NDArray[np.floating]) -> NDArray[np.floating]:
        """(3, N) N, the stiffness at rest, the branch's included, times a field (3, N) m."""
        product: NDArray[np.floating] = (1 + self.stiffness) * self._tissue.tangent_product(field)
        return product

    def energy(self, displacement: NDArray[np.float64]) -> float:
        """J, at a displacement (3, N) m."""
        change = displacement - self.relaxed
        return self.stiffness / 2 * float((change * self._tissue.tangent_product(change)).sum())

    def add_forces(self, displacement: NDArray[np.float64], force: NDArray[np.float64]) -> None:
        """Add the energy's slope at a displacement (3, N) m to ``force`` (3, N) N."""
        own = self.stiffness * self._tissue.tangent_product(displacement - self.relaxed)
        self.load = float(np.linalg.norm(own))
        force += own

    def add_product(self, change: NDArray[np.floating], image: NDArray[np.floating]) -> None:
        """Add how that changes with the displacement, by ``change``, to ``image``, both (3, N)."""
        self._single.tangent_product(change, self._image)
        self._image *= self._image.dtype.type(self.stiffness)
        image += self._image

    def relax(self, displacement: NDArray[np.float64]) -> None:
        """Let the time from one frame to the next pass, the first of which ended as given."""
        self.relaxed = displacement + self._kept * (self.relaxed - displacement)

    def forget(self, displacement: NDArray[np.float64]) -> None:
        """Be relaxed at a displacement (3, N) m."""
        self.relaxed = displacement.copy()
