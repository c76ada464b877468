"""The elastic constants of one kind of tissue.

>>> from us_sim.tissue.elasticity.material import Material
>>> Material(young_modulus="12 kPa", poisson_ratio=0.45).young_modulus
12000.0
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import MaterialError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

YOUNG_MODULUS = Quantity("pressure", 1e-3, 1e13)
POISSON_RATIO = Quantity("number", -0.99, 0.49999)
"""Stable from -1 to 0.5, and at 0.5 linear tetrahedra have no stiffness."""
DENSITY = Quantity("density", 1e-3, 1e6)
LUMEN_PRESSURE = Quantity("pressure", 1.0, 1e5)


@dataclass(frozen=True)
class Material(Settings):
    """Isotropic elastic constants; for `fem_nonlinear`, also the pressure of a vessel's blood.

    With a ``lumen_pressure`` it is the inside of a vessel that empties (see
    `us_sim.tissue.elasticity.lumen`), which the solver ``fem_nonlinear`` knows. To the others it is
    a solid all the same, of the Young's modulus and Poisson's ratio that stand in for it.

    Raises:
        MaterialError: a constant is out of its range.
    """

    section = "material"
    error = MaterialError
    live = True

    young_modulus: float = setting(YOUNG_MODULUS, "Young's modulus")
    poisson_ratio: float = setting(POISSON_RATIO, "Poisson's ratio", default=0.45)
    density: float = setting(DENSITY, "mass per volume", default=1000.0)
    lumen_pressure: float | None = setting(
        LUMEN_PRESSURE, "of a vessel's blood, which leaves if pressed by more", default=None
    )
