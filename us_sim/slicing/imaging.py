"""How echoes become grey values: what a sonographer sets at the console.

>>> from us_sim.slicing.imaging import Imaging
>>> Imaging(gain=6.0).gain
6.0
>>> Imaging(grey_map="purple")
Traceback (most recent call last):
...
us_sim.errors.ProbeError: imaging.grey_map: 'purple' is not one of linear, soft, contrast
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from us_sim.errors import ProbeError
from us_sim.quantity import Quantity, given

__all__ = ["GREY_MAPS", "Imaging"]

GREY_MAPS = ("linear", "soft", "contrast")

_DECIBEL = Quantity("number", -60.0, 60.0)


@dataclass(frozen=True)
class Imaging:
    """The settings of image formation; with the defaults the volume's grey values are shown.

    Raises:
        ProbeError: a value is out of range, with its name and the range.
    """

    gain: float = given(_DECIBEL, default=0.0)  # dB
    # dB at evenly spaced depths from the face to the end of the beams; linear in between
    time_gain: tuple[float, ...] = given(_DECIBEL, default=())
    dynamic_range: float = given(Quantity("number", 10.0, 120.0), default=60.0)  # dB shown
    grey_map: str = given(default="linear", choices=GREY_MAPS)
    elevation_planes: int = given(Quantity("number", 1, 15), default=1)  # 1: an ideally thin slice
    elevation_width: float = given(Quantity("length", 1e-4, 0.02), default=2e-3)  # m, at the focus
    lateral_resolution: float = given(Quantity("length", 0.0, 0.01), default=0.0)  # m, at the focus
    axial_resolution: float = given(Quantity("length", 0.0, 0.01), default=0.0)  # m, at the face
    contact: bool = given(default=False)  # air between face and skin is seen

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            object.__setattr__(self, field.name, _checked(field, getattr(self, field.name)))


def _checked(field: dataclasses.Field[object], value: object) -> object:
    """The value of a field as its type says, within its range or choices."""
    quantity, choices = field.metadata["quantity"], field.metadata["choices"]
    try:
        if field.name == "time_gain":
            if isinstance(value, str) or not hasattr(value, "__iter__"):
                raise ValueError(f"{value!r} is not a list of numbers")
            return tuple(quantity.parse(item) for item in value)
        if choices:
            if value not in choices:
                raise ValueError(f"{value!r} is not one of {', '.join(choices)}")
            return value
        if quantity is None:
            if not isinstance(value, bool):
                raise ValueError(f"{value!r} is not true or false")
            return value
        number = quantity.parse(value)
        if field.type == "int":
            if number != int(number):
                raise ValueError(f"{value!r} is not a whole number")
            return int(number)
        return number
    except ValueError as error:
        raise ProbeError(f"imaging.{field.name}: {error}") from error
