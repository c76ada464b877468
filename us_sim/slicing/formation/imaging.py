"""The settings of image formation: what a sonographer sets at the console.

>>> from us_sim.slicing.formation.imaging import Imaging
>>> Imaging(gain=6.0).gain
6.0
>>> Imaging(grey_map="purple")
Traceback (most recent call last):
...
us_sim.errors.ProbeError: imaging.grey_map: 'purple' is not one of linear, soft, contrast
"""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import ProbeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

ECHO_RANGE = 60.0
"""dB from the faintest echo that a volume holds to the strongest: grey values 0 and 255."""

GREY_MAPS = ("linear", "soft", "contrast")

_GAIN = Quantity("level", -60.0, 60.0)
_RESOLUTION = Quantity("length", 0.0, 0.01)


@dataclass(frozen=True)
class Imaging(Settings):
    """The settings of image formation; with the defaults the volume's grey values are shown.

    Each is a key of a scene's ``imaging:`` and a parameter of the node that makes the images.

    Raises:
        ProbeError: a value is out of range, with its name and the range.
    """

    section = "imaging"
    error = ProbeError
    live = True

    gain: float = setting(_GAIN, default=0.0, description="added to every echo")
    time_gain: tuple[float, ...] = setting(
        _GAIN,
        default=(),
        description="added at evenly spaced depths from the face to the end of the beams, "
        "linear in between",
    )
    dynamic_range: float = setting(
        Quantity("level", 10.0, 120.0),
        default=ECHO_RANGE,
        description="level shown from black to white",
    )
    grey_map: str = setting(
        default="linear",
        choices=GREY_MAPS,
        description="curve from dB to grey: soft lifts faint echoes, contrast parts middle ones",
    )
    elevation_planes: int = setting(
        Quantity("number", 1, 15),
        default=1,
        description="slices averaged across the thickness of the beam; 1 is ideally thin",
    )
    elevation_width: float = setting(
        Quantity("length", 1e-4, 0.02),
        default=2e-3,
        description="thickness of the beam at its focus, full width at half maximum",
    )
    lateral_resolution: float = setting(
        _RESOLUTION,
        default=0.0,
        description="width of a point along the array at the focus, 6 dB below its peak; "
        "0 is ideal",
    )
    axial_resolution: float = setting(
        _RESOLUTION,
        default=0.0,
        description="length of a point along the beam at the face, 6 dB below its peak; 0 is ideal",
    )
    contact: bool = setting(
        default=False,
        description="whether beams whose part of the face touches no skin see only air",
    )
    reverberation: float = setting(
        Quantity("level", -ECHO_RANGE, 0.0),
        default=-10.0,
        description="the face's first echo in air, where the strongest echo is 0",
    )

    @property
    def changes_grey_levels(self) -> bool:
        """Whether echoes are shown with grey values other than the volume's own."""
        plain = (0.0, ECHO_RANGE, "linear")
        return any(self.time_gain) or plain != (self.gain, self.dynamic_range, self.grey_map)
