"""Settings of the console: image formation, strain, M-mode, flow and Doppler."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from us_sim.errors import ProbeError, SceneError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


class ImageMode(NamedTuple):
    """A further picture that a page can show: its label, its tooltip, and the topic it is of."""

    label: str
    title: str
    topic: str


OVERLAYS = {
    "strain": ImageMode(
        "Strain",
        "How much the tissue is shortened along the beams since rest, exactly",
        "ultrasound/strain",
    ),
    "strain_estimate": ImageMode(
        "Elastography",
        "Strain between two images, as a scanner estimates it",
        "ultrasound/strain_estimate",
    ),
    "velocity": ImageMode(
        "Colour",
        "Velocity of blood along the beams, as colour Doppler shows it",
        "ultrasound/velocity_estimate",
    ),
}
"""Colours over the annotated image, by the parameter ``overlay``, which may be ``none`` too."""

STRIPS = {
    "m_mode": ImageMode(
        "M-mode", "Echoes along one line of the image over time", "ultrasound/m_mode"
    ),
    "spectrum": ImageMode(
        "Spectrum",
        "Velocities of blood at the gate over time: pulsed-wave Doppler",
        "ultrasound/spectrum",
    ),
}
"""Pictures that run over time, by the prefix of their parameters."""

WALLS_TOUCH = 0.27
"""Part of a vessel's area at rest at which opposite walls touch, so that it is closed: Flaherty,
Keller and Rubinow, Post buckling behavior of elastic tubes, SIAM J. Appl. Math. 23 (1972)."""

TISSUE_PARAMETERS = "acoustics.tissues."  # prefix of the parameters of a label's acoustics
ECHO_RANGE = 60.0
"""dB from the faintest echo that a volume holds to the strongest, grey values 0 and 255; kernels
have it, too."""

GREY_MAPS = ("linear", "soft", "contrast")
_GAIN = Quantity("level", -60.0, 60.0)
_RESOLUTION = Quantity("length", 0.0, 0.01)


@dataclass(frozen=True)
class Imaging(Settings):
    """The settings of image formation; with the defaults the volume's grey values are shown.

    Each is a key of a scene's ``imaging:`` and a parameter of the node that makes the images.
    """

    section = "imaging"
    error = ProbeError
    live = True

    gain: float = setting(_GAIN, "added to every echo", default=0.0)
    time_gain: tuple[float, ...] = setting(
        _GAIN,
        "added at evenly spaced depths from the face to the end of the beams, linear in between",
        default=(),
    )
    dynamic_range: float = setting(
        Quantity("level", 10.0, 120.0), "level shown from black to white", default=ECHO_RANGE
    )
    grey_map: str = setting(
        default="linear",
        choices=GREY_MAPS,
        description="curve from dB to grey: soft lifts faint echoes, contrast parts middle ones",
    )
    elevation_planes: int = setting(
        Quantity("number", 1, 15),
        "slices averaged across the thickness of the beam; 1 is ideally thin",
        default=1,
    )
    elevation_width: float = setting(
        Quantity("length", 1e-4, 0.02),
        "thickness of the beam at its focus, full width at half maximum",
        default=2e-3,
    )
    lateral_resolution: float = setting(
        _RESOLUTION,
        "width of a point along the array at the focus, 6 dB below its peak; 0 is ideal",
        default=0.0,
    )
    axial_resolution: float = setting(
        _RESOLUTION,
        "length of a point along the beam at the face, 6 dB below its peak; 0 is ideal",
        default=0.0,
    )
    contact: bool = setting(
        default=False,
        description="whether beams whose part of the face touches no skin see only air",
    )
    reverberation: float = setting(
        Quantity("level", -ECHO_RANGE, 0.0),
        "the face's first echo in air, where the strongest echo is 0",
        default=-10.0,
    )

    @property
    def changes_grey_levels(self) -> bool:
        """True if echoes are shown with grey values other than the volume's own."""
        plain = (0.0, ECHO_RANGE, "linear")
        return any(self.time_gain) or plain != (self.gain, self.dynamic_range, self.grey_map)


_LENGTH = Quantity("length", 0.2e-3, 0.05)


@dataclass(frozen=True)
class StrainSettings(Settings):
    """Strain images: the tissue's own, and an estimate made from two images as a scanner makes it.

    The estimate finds windows of one image again in the other, along the beams.
    """

    section = "strain"
    error = ProbeError
    live = True

    since: str = setting(
        default="rest",
        choices=("rest", "image"),
        description="from which the tissue's own strain counts: rest, or the image that the "
        "estimate uses",
    )
    interval: int = setting(
        Quantity("number", 1, 60),
        "images between the two compared; a slow press needs several",
        default=2,
    )
    colours: float | None = setting(
        Quantity("number", 1e-4, 1.0),
        "strain at the ends of the colour bar; not given: a round value that follows the images",
        default=None,
    )
    window: float = setting(
        _LENGTH,
        "of a tracked window along the beam; a third of it across",
        default=3e-3,
    )
    search: float = setting(
        Quantity("length", 0.05e-3, 0.02),
        "farthest that a window is searched along the beam",
        default=0.6e-3,
    )
    fit: float = setting(
        _LENGTH,
        "of the line fitted to the displacement, whose slope is the strain",
        default=6e-3,
    )
    correlation: float = setting(
        Quantity("number", 0.0, 1.0),
        "of a window with its match: the lowest that is used",
        default=0.7,
    )


@dataclass(frozen=True)
class MModeSettings(Settings):
    """The line, and how long it is shown."""

    section = "m_mode"
    error = ProbeError
    live = True

    lateral: float = setting(
        Quantity("number", -0.5, 0.5),
        "of the line, as a fraction of the face or the opening angle",
        default=0.0,
    )
    sweep: float = setting(Quantity("time", 0.5, 20.0), "that the picture shows", default=4.0)


_PRESSURE = Quantity("pressure", 10.0, 40e3)
_RATE = Quantity("rate", 0.02, 5.0)
_VENOUS = ("kind", ("venous",))
_ARTERIAL_PRESSURE, _VENOUS_PRESSURE = 12.4e3, 1.0e3
"""Pa, mean pressures in a vessel of the arm at the height of the heart: 93 and 8 mmHg
(Hall, Guyton and Hall Textbook of Medical Physiology, 13th ed., 2016, chapters 14 and 15)."""


@dataclass(frozen=True)
class FlowSettings(Settings):
    """The blood in a vessel: its velocity, direction and pulse.

    The defaults of the pressures are those of Hall, Guyton and Hall Textbook of Medical Physiology,
    13th ed., 2016, chapters 14 and 15.

    Raises:
        SceneError: a value is out of range, or two do not go together.
    """

    section = "flow"
    error = SceneError
    live = True

    kind: str = setting(
        description="arterial: a pulse, and pressure enough to go on until the vessel closes; "
        "venous: swings with breathing, fills up behind a closure and surges once that opens",
        choices=("arterial", "venous"),
    )
    direction: tuple[float, float, float] = setting(
        Quantity("number", -1.0, 1.0),
        "in which blood flows, x, y, z in `patient`; approximately",
    )
    peak_velocity: float = setting(
        Quantity("speed", 0.01, 5.0),
        "on the vessel's axis at the height of the pulse: an artery's systolic peak",
    )
    mean_velocity: float = setting(
        Quantity("speed", 1e-3, 2.0), "over time and the cross-section, with the tissue at rest"
    )
    heart_rate: float = setting(_RATE, "beats: `66 /min`", default=1.1)
    respiration_rate: float = setting(_RATE, "breaths: `15 /min`", default=0.25, applies=_VENOUS)
    pressure: float | None = setting(
        _PRESSURE,
        "mean at rest, above that downstream; not given: 12.4 kPa arterial, 1 kPa venous",
        default=None,
    )
    bed_pressure: float = setting(
        Quantity("pressure", 1e3, 40e3),
        "mean in the capillaries, up to which a closed vein fills; divided by the vein's pressure, "
        "it is the ratio of the first surge to the flow at rest",
        default=3.3e3,
        applies=_VENOUS,
    )
    filling_time: float = setting(
        Quantity("time", 0.05, 120.0),
        "time constant of the filling behind a closure",
        default=6.0,
        applies=_VENOUS,
    )
    closed_at: float = setting(
        Quantity("number", 0.0, 0.9),
        "fraction of its area at rest at which opposite walls touch and the vessel is closed",
        default=WALLS_TOUCH,
    )

    def check(self) -> None:
        """Refuse velocities, pressures and a direction that cannot be."""
        if math.hypot(*self.direction) < 1e-3:
            raise self.make_error("direction", "has no length: give where the blood flows")
        if self.peak_velocity < 2.0 * self.mean_velocity:
            raise self.make_error(
                "peak_velocity",
                f"{self.peak_velocity:g} m/s is less than twice mean_velocity, "
                f"{self.mean_velocity:g} m/s: on the axis of a vessel blood flows twice as fast as "
                f"in its mean",
            )
        if self.kind == "venous" and self.bed_pressure <= self.pressure_at_rest:
            raise self.make_error(
                "bed_pressure",
                f"{self.bed_pressure:g} Pa is not above the {self.pressure_at_rest:g} Pa in the "
                f"vein, so nothing would flow into it",
            )

    @property
    def pressure_at_rest(self) -> float:
        """Pa, mean in the vessel at rest, over that where its blood goes."""
        if self.pressure is not None:
            return self.pressure
        return _ARTERIAL_PRESSURE if self.kind == "arterial" else _VENOUS_PRESSURE


@dataclass(frozen=True)
class DopplerSettings(Settings):
    """Beams and velocities of Doppler ultrasound.

    Raises:
        ProbeError: a value is out of range, or the wall filter takes all velocities.
    """

    error = ProbeError
    live = True

    lateral: float = setting(
        Quantity("number", -0.5, 0.5),
        "of the middle, as a fraction of the face or the opening angle",
        default=0.0,
    )
    depth: float | None = setting(
        Quantity("length", 1e-3, 0.4), "of the middle; not given: the image's middle", default=None
    )
    follow: bool = setting(description="keep the middle on the nearest vessel", default=False)
    steering: float = setting(
        Quantity("angle", math.radians(-30), math.radians(30)),
        "of the beams towards +x of the probe; linear probes only",
        default=0.0,
    )
    nyquist_velocity: float = setting(
        Quantity("speed", 0.01, 5.0), "along the beam, at which velocities alias", default=0.3
    )
    wall_filter: float = setting(
        Quantity("speed", 0.0, 0.2), "along the beam, at which echoes are halved", default=0.015
    )
    gain: float = setting(Quantity("level", -30.0, 30.0), "of the blood's echoes", default=0.0)

    def check(self) -> None:
        """Refuse a wall filter that leaves nothing."""
        if self.wall_filter >= self.nyquist_velocity:
            raise self.make_error(
                "wall_filter",
                f"{self.wall_filter:g} m/s is not below nyquist_velocity, "
                f"{self.nyquist_velocity:g} m/s: nothing would be left to show",
            )


@dataclass(frozen=True)
class ColourSettings(DopplerSettings):
    """The colour box, and how velocities in it are estimated."""

    section = "colour"

    width: float = setting(
        Quantity("number", 0.02, 1.0),
        "of the box, as a fraction of the face or the opening angle",
        default=0.5,
    )
    height: float | None = setting(
        Quantity("length", 1e-3, 0.4),
        "of the box along the beams; not given: half of the image",
        default=None,
    )
    pulses: int = setting(
        Quantity("number", 3, 64), "along each beam; the more, the less noise", default=10
    )
    resolution: float = setting(
        Quantity("length", 0.0, 5e-3), "full width at half maximum", default=0.6e-3
    )
    persistence: float = setting(
        Quantity("number", 0.0, 0.95), "weight of earlier frames", default=0.3
    )


@dataclass(frozen=True)
class SpectrumSettings(DopplerSettings):
    """The gate, and how its spectrum is shown."""

    section = "spectrum"

    size: float = setting(
        Quantity("length", 5e-4, 0.02), "length of the gate along the beam", default=1.5e-3
    )
    angle_correction: float = setting(
        Quantity("angle", math.radians(-80), math.radians(80)),
        "between beam and vessel, as the sonographer sets it",
        default=0.0,
    )
    baseline: float = setting(
        Quantity("number", -0.9, 0.9),
        "how far 0 m/s is moved down, as a fraction of the Nyquist velocity",
        default=0.0,
    )
    dynamic_range: float = setting(
        Quantity("level", 10.0, 80.0), "level from black to white", default=30.0
    )
    sweep: float = setting(Quantity("time", 0.5, 20.0), "that the picture shows", default=4.0)
