"""Elastic constants of one kind of tissue, and usual values of kinds that nobody measured.

Moduli of healthy adults at rest, for slow and moderate strains; a patient's own may differ by a
factor of two and more. Sources, by kind:

- fat and muscle: 10 and 15 kPa, as in the scene `upper_arm`, with which the forces of presses on
  arms in vivo come out right in sum (factor 1.03). Aspiration and shear waves, which are small
  strains, give 3 and 11 kPa, with which they come out 1.7 times too small.
- kidney, pancreas, spleen, tendon, gland: shear-wave elastography of 127 volunteers (Arda
  et al., Am J Roentgenol 197:532, 2011).
- liver: 117 volunteers (Dhar et al., Int J Med Res Rev, 2022), 4.7 kPa; 45 (Basnet et al., J Nepal
  Med Assoc, 2014), 4.2 kPa.
- skin: 56 kPa by aspiration in vivo ("In vivo measurement of breast tissues stiffness using a
  light aspiration device", seven volunteers); a segmented skin is as thick as a few voxels and
  holds some of the tissue under it, so it is taken softer.
- artery: 200 kPa, a wall under blood pressure, filled; vein: a lumen at a pressure of 8 mmHg, with
  the constants of the scene `upper_arm`.
- bone and cartilage: stiff enough to keep their shape beside the others, and no stiffer, since
  that only costs solvers time.
- nerve: 40 kPa, of the same scene. fluid: of a cyst, a bladder: hardly resists, and is kept in.
- thrombus: of nobody; so stiff that a vein stays open where it is.

>>> from us_sim.tissue.elasticity.material import KINDS, guess_tissue_kind
>>> guess_tissue_kind("Left hepatic vein"), KINDS["liver"].young_modulus
('vein', 4700.0)
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from us_sim.errors import MeshError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

YOUNG_MODULUS = Quantity("pressure", 1e-3, 1e13)
# Stable from -1 to 0.5, and at 0.5 linear tetrahedra have no stiffness.
POISSON_RATIO = Quantity("number", -0.99, 0.49999)
DENSITY = Quantity("density", 1e-3, 1e6)
LUMEN_PRESSURE = Quantity("pressure", 1.0, 1e5)


@dataclass(frozen=True)
class Material(Settings):
    """Isotropic elastic constants; for `fem_nonlinear`, also a vessel's pressure.

    With a ``lumen_pressure`` it is the inside of a vessel that empties (see
    `neo_hookean_material`), which the solver ``fem_nonlinear`` knows. To the others it is
    a solid all the same, of the Young's modulus and Poisson's ratio that stand in for it.

    Raises:
        MeshError: a constant is out of its range.

    Examples:
        >>> Material(young_modulus=12e3, poisson_ratio=0.49).density
        1000.0
    """

    section = "material"
    error = MeshError
    live = True

    young_modulus: float = setting(YOUNG_MODULUS, "Young's modulus")
    poisson_ratio: float = setting(POISSON_RATIO, "Poisson's ratio", default=0.45)
    density: float = setting(DENSITY, "mass per volume", default=1000.0)
    lumen_pressure: float | None = setting(
        LUMEN_PRESSURE, "of a vessel's blood, which leaves under more", default=None
    )


_BLOOD = 1060.0  # kg/m3
_VENOUS = 1e3  # Pa, 8 mmHg


def _soft(young_modulus: float, density: float = 1060.0) -> Material:
    return Material(young_modulus, 0.45, density)


# By name. The first is for whatever has no name that is known.
KINDS: Mapping[str, Material] = {
    "tissue": _soft(6e3),
    "skin": _soft(30e3, 1100.0),
    "fat": _soft(10e3, 920.0),
    "muscle": _soft(15e3),
    "liver": _soft(4.7e3),
    "kidney": _soft(5e3),
    "spleen": _soft(2.9e3),
    "pancreas": _soft(4.8e3),
    "gland": _soft(10.7e3),
    "tendon": _soft(51.5e3, 1100.0),
    "nerve": _soft(40e3),
    "artery": _soft(200e3),
    "vein": Material(5e3, 0.1, _BLOOD, _VENOUS),
    "thrombus": _soft(50e3),
    "fluid": Material(1e3, 0.49, 1010.0),
    "cartilage": Material(500e3, 0.45, 1100.0),
    "bone": Material(10e6, 0.3, 1900.0),
}

# Kinds that lie in layers and fill the space between organs, with which they move.
LAYERS = ("tissue", "skin", "fat", "muscle")
_WORDS = {
    **{kind: kind for kind in KINDS},
    "aorta": "artery",
    "arteries": "artery",
    "carotid": "artery",
    "veins": "vein",
    "vessel": "vein",
    "vessels": "vein",
    "cava": "vein",
    "portal": "vein",
    "jugular": "vein",
    "lumen": "vein",
    "rib": "bone",
    "ribs": "bone",
    "bones": "bone",
    "vertebra": "bone",
    "spine": "bone",
    "humerus": "bone",
    "radius": "bone",
    "ulna": "bone",
    "femur": "bone",
    "tibia": "bone",
    "muscles": "muscle",
    "biceps": "muscle",
    "diaphragm": "muscle",
    "heart": "muscle",
    "thyroid": "gland",
    "parotid": "gland",
    "prostate": "gland",
    "breast": "fat",
    "gallbladder": "fluid",
    "bladder": "fluid",
    "cyst": "fluid",
    "bile": "fluid",
    "renal": "kidney",
    "kidneys": "kidney",
    "nerves": "nerve",
    "tendons": "tendon",
    "dermis": "skin",
    "subcutis": "fat",
    "adipose": "fat",
}


def guess_tissue_kind(name: str) -> str:
    """Guess the kind of tissue from a structure's name; of several known words the last counts."""
    words = [word for word in re.split(r"[^a-z]+", name.lower()) if word in _WORDS]
    return _WORDS[words[-1]] if words else next(iter(KINDS))
