"""Acoustic constants of tissues, and the settings of sound's artefacts."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from us_sim.errors import ProbeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.structure_names import AROUND

# dB/cm/MHz and Rayl, by words of a label's name.
# Szabo, Diagnostic Ultrasound Imaging: Inside Out (2nd ed., 2014), Appendix B, table B.1.
_CONSTANTS: tuple[tuple[float, float, str], ...] = (
    (0.14, 1.679e6, "blood artery arteries aorta vein veins vena cava portal vessel vessels lumen"),
    (3.54, 6.364e6, "bone bones rib ribs humerus femur radius ulna tibia fibula clavicle"),
    (3.54, 6.364e6, "vertebra vertebrae"),
    (0.6, 1.327e6, "fat adipose"),
    (0.57, 1.645e6, "muscle muscles"),
    (0.45, 1.657e6, "liver"),
    (0.4, 1.652e6, "spleen"),
    (0.58, 1.617e6, "brain nerve nerves"),  # nervous tissue
    (0.75, 1.54e6, "breast"),
    (0.52, 1.647e6, "heart myocardium"),
    (2.17e-3, 1.482e6, "water fluid bile gallbladder bladder cyst urine"),
    # Culjat, Goldenberg, Tewari, Singh, Ultrasound Med Biol 36 (2010) 861-873, table 1.
    (1.57, 1.81e6, "fascia ligament capsule"),
    (4.7, 1.84e6, "tendon tendons"),
    (0.54, 1.63e6, f"{AROUND} background"),
    # Attenuation: Narayana, Ophir, Maklad, J Ultrasound Med 3 (1984) 461-464.
    (7.5, 400.0, "air gas lung lungs"),
    # Aubry et al., J Acoust Soc Am 152 (2022) 1003-1019: 1610 m/s, 1090 kg/m3.
    (0.4, 1.755e6, "skin"),
)
_TABLE = {
    word: (loss, impedance) for loss, impedance, words in _CONSTANTS for word in words.split()
}
_FREQUENCY = Quantity("frequency", 0.5e6, 50e6)


@dataclass(frozen=True)
class TissueAcoustics(Settings):
    """The acoustic constants of the tissue with one label."""

    section = "imaging.acoustics.tissues"
    error = ProbeError
    live = True

    attenuation: float | None = setting(
        Quantity("attenuation", 1e-4, 100.0),
        "of the amplitude; not given: the textbook's for this name",
        default=None,
    )
    impedance: float | None = setting(
        Quantity("acoustic impedance", 100.0, 1e8),
        "characteristic; not given: the textbook's for this name",
        default=None,
    )
    reflection: float | None = setting(
        Quantity("level", -60.0, 20.0),
        "echo of its surface at a right angle, where the strongest shown is 0; not given: what the "
        "two impedances make",
        default=None,
    )
    scattering: float = setting(
        Quantity("level", -60.0, 60.0), "added to the echoes that the volume holds", default=0.0
    )
    fibres: tuple[float, float, float] | None = setting(
        Quantity("number", -1.0, 1.0), "x, y, z in `patient` of its fibres at rest", default=None
    )
    anisotropy: float = setting(
        Quantity("level", 0.0, 60.0), "most by which echoes fall along the fibres", default=12.0
    )
    half_angle: float = setting(
        Quantity("angle", math.radians(1), math.radians(89)),
        "between the beam and the fibres' perpendicular at which they fall by half of that",
        default=math.radians(20),
    )

    def check(self) -> None:
        """Refuse fibres without a direction."""
        if self.fibres is not None and not any(self.fibres):
            raise self.make_error("fibres", "0, 0, 0 is no direction: leave it out for none")

    @property
    def has_fibres(self) -> bool:
        """True if its echoes depend on a direction."""
        return self.fibres is not None and self.anisotropy > 0.0

    def fill_from_table(self, name: str) -> TissueAcoustics:
        """Fill in the textbook's constants of a label's name where none are given.

        Of several known words in a name the last one counts. Attenuation is taken as proportional
        to the frequency: the source's coefficient at 1 MHz.

        Raises:
            ProbeError: the textbook has none for that name; ``key`` says which.
        """
        words = [word for word in re.split(r"[^a-z]+", name.lower()) if word in _TABLE]
        values: dict[str, Any] = {}
        for place, key in enumerate(("attenuation", "impedance")):
            if getattr(self, key) is None:
                if not words:
                    raise self.make_error(
                        f"{name}.{key}",
                        f"is missing, and the table of textbooks' constants has no tissue of the "
                        f"name `{name}`: give its {key}",
                    )
                values[key] = _TABLE[words[-1]][place]
        return dataclasses.replace(self, **values) if values else self


@dataclass(frozen=True)
class SoundSettings(Settings):
    """Artefacts of sound made along the current beams; a part that is off costs nothing."""

    section = "imaging.acoustics"
    error = ProbeError
    live = True

    artefacts: str = setting(
        description="baked: the volume holds the shadows of its own sweep; live: it holds echoes "
        "without loss, and its labels say what beams meet",
        choices=("baked", "live"),
        default="baked",
    )
    frequency: float | None = setting(
        _FREQUENCY,
        "of the pulse's middle; not given: the middle of what the probe has",
        default=None,
    )
    volume_frequency: float | None = setting(
        _FREQUENCY,
        "at which the volume's speckle was made, which lower ones blur; not given: any",
        default=None,
    )
    compensation: float = setting(
        Quantity("attenuation", 0.0, 10.0),
        "of a nominal tissue, which the time gain compensates",
        default=0.54,
    )
    attenuation: bool = setting(
        description="loss along the beams: shadows, and enhancement behind fluid", default=True
    )
    surfaces: bool = setting(
        description="echoes of surfaces between tissues, by their angle", default=True
    )
    anisotropy: bool = setting(description="fading of fibres off the perpendicular", default=True)
    noise: float | None = setting(
        Quantity("level", -160.0, 0.0),
        "of the electronics at the face, which the time gain lifts; not given: none",
        default=None,
    )

    @property
    def is_live(self) -> bool:
        """True if artefacts are made along the beams."""
        return self.artefacts == "live"

    def choose_frequency(self, frequencies: tuple[float, float]) -> float:
        """Return the frequency (Hz) that is set, or the middle of those that a probe has.

        Raises:
            ProbeError: the probe cannot have it.
        """
        low, high = frequencies
        if self.frequency is None:
            return math.sqrt(low * high)
        if not low <= self.frequency <= high:
            raise self.make_error(
                "frequency",
                f"{self.frequency * 1e-6:g} MHz is not one that this probe has, which are "
                f"{low * 1e-6:g} to {high * 1e-6:g} MHz (probe.frequencies)",
            )
        return self.frequency


@dataclass(frozen=True)
class Acoustics(SoundSettings):
    """Artefacts of sound along the current beams, and the acoustic constants of each tissue."""

    tissues: Mapping[str, TissueAcoustics] = setting(
        description="constants by label; else the textbook's", default_factory=dict
    )
