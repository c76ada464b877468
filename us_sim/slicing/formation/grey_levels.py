"""Tables from echo levels to grey values: gain, time gain, dynamic range and grey map.

A volume's grey values are levels: 255 is the strongest echo, each 4.25 less is one decibel less,
and 0 is no echo, which no gain makes visible. The faintest echoes fade to black over the
last 4 dB above no echo, so that there is no hard edge where gain lifts them.

>>> import numpy as np
>>> from us_sim.slicing.formation.grey_levels import GreyLevels
>>> from us_sim.slicing.formation.imaging import Imaging
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> levels = GreyLevels(LinearProbe(0.04, 0.04, 3, 1), Imaging(gain=12.0))
>>> levels.shown(np.array([[0, 100, 250]], dtype=np.uint8))
array([[  0, 151, 255]], dtype=uint8)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.formation.imaging import ECHO_RANGE, Imaging
from us_sim.slicing.probe.beams import depth_steps, step_depths
from us_sim.slicing.probe.probe import Probe

GREYS_PER_DECIBEL = 255.0 / ECHO_RANGE

_SOFT = 0.7  # exponent of the soft map
_FADE = 17.0  # grey values over which the faintest echoes fade


class GreyLevels:
    """The console's last stage, as one table for each step of depth.

    A level of L dB (0 the strongest) is shown as ``255 m(1 + (L + gain + time gain) / range)``,
    black below and white above, with m the grey map:

    - ``linear``: m(t) = t
    - ``soft``: m(t) = t^0.7, which lifts faint echoes
    - ``contrast``: m(t) = t² (3 - 2 t), which parts middle greys and darkens faint echoes
    """

    def __init__(self, probe: Probe, imaging: Imaging) -> None:
        self._steps: NDArray[np.uint16] | None = None
        gain = np.array([imaging.gain])
        if any(imaging.time_gain):
            self._steps = depth_steps(probe)
            at = np.linspace(0.0, probe.depth, len(imaging.time_gain))
            gain = imaging.gain + np.interp(step_depths(probe), at, imaging.time_gain)
        grey = np.arange(256)
        level = grey / GREYS_PER_DECIBEL - ECHO_RANGE + gain[:, None]  # dB
        ramp = np.clip(1.0 + level / imaging.dynamic_range, 0.0, 1.0)
        if imaging.grey_map == "soft":
            ramp = ramp**_SOFT
        elif imaging.grey_map == "contrast":
            ramp = ramp * ramp * (3.0 - 2.0 * ramp)
        ramp -= ramp[:, :1] * np.maximum(1.0 - grey / _FADE, 0.0)
        # Halves are rounded up, also where the sum of decibels is a rounding error below one.
        self._tables = np.floor(255.0 * ramp + (0.5 + 1e-9)).astype(np.uint8)

    def shown(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The grey values (rows, columns) of echo levels (rows, columns)."""
        out = np.empty_like(image)
        if self._steps is None:
            _look_up(image.reshape(-1), self._tables[0], out.reshape(-1))
        else:
            flat = image.reshape(-1), self._steps.reshape(-1)
            _look_up_by_step(*flat, self._tables.reshape(-1), out.reshape(-1))
        return out


@njit(cache=True, nogil=True, error_model="numpy")
def _look_up(image, table, out):
    for i in range(len(image)):
        out[i] = table[image[i]]


@njit(cache=True, nogil=True, error_model="numpy")
def _look_up_by_step(image, steps, tables, out):
    """Fills out; the tables of 256 entries lie one after the other."""
    for i in range(len(image)):
        out[i] = tables[np.uint32(steps[i]) << np.uint32(8) | np.uint32(image[i])]
