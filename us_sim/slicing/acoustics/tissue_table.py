"""Acoustic constants of tissues by name, from textbooks.

Attenuation is taken as proportional to the frequency. Where the source gives a power of it, what
stands here is its coefficient at 1 MHz.

>>> from us_sim.slicing.acoustics.tissue_table import table_constants
>>> table_constants("brachial vein")  # blood
(0.14, 1679000.0)
>>> table_constants("lymph node") is None
True
"""

from __future__ import annotations

import re

AROUND = "tissue"
"""The name of what is in no structure."""

# Szabo, Diagnostic Ultrasound Imaging: Inside Out (2nd ed., 2014), Appendix B, table B.1.
_BLOOD = (0.14, 1.679e6)
_BONE = (3.54, 6.364e6)
_FAT = (0.6, 1.327e6)
_MUSCLE = (0.57, 1.645e6)
_LIVER = (0.45, 1.657e6)
_SPLEEN = (0.4, 1.652e6)
_BRAIN = (0.58, 1.617e6)
_BREAST = (0.75, 1.54e6)
_HEART = (0.52, 1.647e6)
_WATER = (2.17e-3, 1.482e6)
# Culjat, Goldenberg, Tewari, Singh, Ultrasound Med Biol 36 (2010) 861-873, table 1.
_CONNECTIVE = (1.57, 1.81e6)
_TENDON = (4.7, 1.84e6)
_SOFT_TISSUE = (0.54, 1.63e6)
_AIR = (7.5, 400.0)  # attenuation: Narayana, Ophir, Maklad, J Ultrasound Med 3 (1984) 461-464
# Aubry et al., J Acoust Soc Am 152 (2022) 1003-1019: 0.4 dB/cm/MHz, 1610 m/s, 1090 kg/m3.
_SKIN = (0.4, 1.755e6)

_TABLE: dict[str, tuple[float, float]] = {
    AROUND: _SOFT_TISSUE,
    "background": _SOFT_TISSUE,
    "blood": _BLOOD,
    "artery": _BLOOD,
    "arteries": _BLOOD,
    "aorta": _BLOOD,
    "vein": _BLOOD,
    "veins": _BLOOD,
    "vena": _BLOOD,
    "cava": _BLOOD,
    "portal": _BLOOD,
    "vessel": _BLOOD,
    "vessels": _BLOOD,
    "lumen": _BLOOD,
    "bone": _BONE,
    "bones": _BONE,
    "rib": _BONE,
    "ribs": _BONE,
    "humerus": _BONE,
    "femur": _BONE,
    "radius": _BONE,
    "ulna": _BONE,
    "tibia": _BONE,
    "fibula": _BONE,
    "clavicle": _BONE,
    "vertebra": _BONE,
    "vertebrae": _BONE,
    "fat": _FAT,
    "adipose": _FAT,
    "muscle": _MUSCLE,
    "muscles": _MUSCLE,
    "liver": _LIVER,
    "spleen": _SPLEEN,
    "brain": _BRAIN,
    "nerve": _BRAIN,  # nervous tissue
    "nerves": _BRAIN,
    "breast": _BREAST,
    "heart": _HEART,
    "myocardium": _HEART,
    "water": _WATER,
    "fluid": _WATER,
    "bile": _WATER,
    "gallbladder": _WATER,
    "bladder": _WATER,
    "cyst": _WATER,
    "urine": _WATER,
    "skin": _SKIN,
    "fascia": _CONNECTIVE,
    "ligament": _CONNECTIVE,
    "capsule": _CONNECTIVE,
    "tendon": _TENDON,
    "tendons": _TENDON,
    "air": _AIR,
    "gas": _AIR,
    "lung": _AIR,
    "lungs": _AIR,
}


def table_constants(name: str) -> tuple[float, float] | None:
    """Attenuation (dB/cm/MHz) and impedance (Rayl) of what a label's name says.

    Of several known words in a name the last one counts; None where there is none.
    """
    words = [word for word in re.split(r"[^a-z]+", name.lower()) if word in _TABLE]
    return _TABLE[words[-1]] if words else None
