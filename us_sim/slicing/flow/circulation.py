"""What drives a vessel's flow, and how that changes while the vessel is pressed: a lumped model.

Blood comes from a bed of capillaries at pressure P through a resistance into a reservoir, the veins
on the way, at pressure p. From there it flows through the vessel and on to where the pressure is
zero. The reservoir is elastic, which makes this a Windkessel (N. Westerhof, J.-W. Lankhaar, B. E.
Westerhof, The arterial Windkessel, Med. Biol. Eng. Comput. 47, 2009):

    q = p / (D + R),    T dp/dt = (P - p) - S q.

The resistance S of the bed and D downstream are those with which flow and pressure at rest have
their settings' values, and T is the time constant with which a closed vein fills up. R is
Poiseuille's resistance of the vessel itself, whose open area a differs from place to place:

    R = sum of 8 pi mu ds / a^2.

An artery has no reservoir behind a bed but the heart's pressure, p = P. Inertia is left out, and so
is what a stenosis loses by turbulence behind it.

A vessel is closed where opposite walls touch. For an elastic tube that is at 0.27 of its area at
rest (J. E. Flaherty, J. B. Keller, S. I. Rubinow, Post buckling behavior of elastic tubes and
rings with opposite sides in contact, SIAM J. Appl. Math. 23, 1972). What is open of a lumen is
taken to fall to nothing there, evenly with its area.

>>> import numpy as np
>>> from us_sim.slicing.flow.circulation import Circulation
>>> from us_sim.slicing.flow.settings import FlowSettings
>>> vein = FlowSettings("venous", (0, -1, 0), peak_velocity=0.15, mean_velocity=0.05)
>>> flow = Circulation(vein, rest_areas=np.full(30, 3e-5), spacing=2e-3)
>>> at_rest, closed = np.full(30, 3e-5), np.full(30, 0.7e-5)
>>> steps = [(0.0, at_rest), (1.0, closed), (31.0, closed), (31.01, at_rest), (60.0, at_rest)]
>>> [round(flow.advance(time, areas) / flow.at_rest, 2) for time, areas in steps]
[1.0, 0.0, 0.0, 3.27, 1.0]
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.flow.settings import FlowSettings

VISCOSITY = 3.5e-3
"""Pa s, of blood where it is sheared fast (W. W. Nichols, M. F. O'Rourke, McDonald's Blood Flow in
Arteries, 5th ed., 2005, chapter 2: 3 to 4)."""

_SHUT = 1e-3
"""Open fraction of a lumen below which it is shut: its resistance is a million times that at rest,
and what is left of the flow not to be seen."""


def open_fraction(area: NDArray[np.float64], closed_at: float) -> NDArray[np.float64]:
    """What is open of a lumen over what is at rest, from areas over those at rest."""
    return np.asarray(np.maximum(area - closed_at, 0.0) / (1.0 - closed_at))


class Circulation:
    """Flow along a vessel as its lumen narrows and opens, averaged over the pulse.

    Args:
        settings: of the flow.
        rest_areas: (S,) m², of the lumen at rest, at places evenly spaced along it.
        spacing: m, between them.
        before: the same vessel with other settings, whose reservoir this one takes over.
    """

    def __init__(
        self,
        settings: FlowSettings,
        rest_areas: NDArray[np.float64],
        spacing: float,
        before: Circulation | None = None,
    ) -> None:
        self._closed_at = settings.closed_at
        self._rest_areas = rest_areas
        self._resistances = 8 * math.pi * VISCOSITY * spacing / rest_areas**2
        self.at_rest = settings.mean_velocity * float(rest_areas.mean())
        """m³/s, mean flow with the tissue at rest."""
        self._rest_pressure = settings.pressure_at_rest
        # A vessel longer or narrower than its pressure drives blood through has all the resistance.
        whole = self._rest_pressure / self.at_rest
        own = min(1.0, 0.9 * whole / float(self._resistances.sum()))
        self._resistances *= own
        self._downstream = whole - float(self._resistances.sum())
        self._reservoir = settings.kind == "venous"
        self._source = settings.bed_pressure if self._reservoir else self._rest_pressure
        self._bed = (self._source - self._rest_pressure) / self.at_rest
        self._filling_time = settings.filling_time
        self._pressure = self._rest_pressure
        self._time: float | None = None
        if before is not None and before._reservoir and self._reservoir:
            self._pressure, self._time = min(before._pressure, self._source), before._time

    @property
    def pressure(self) -> float:
        """Pa, in the reservoir before the vessel."""
        return self._pressure

    def advance(self, time: float, areas: NDArray[np.float64]) -> float:
        """Flow averaged over the pulse, m³/s, at a time (s), with areas (S,) m² since the last.

        Where time goes back, as when a recording begins again, the reservoir is as at rest.
        """
        open_ = open_fraction(areas / self._rest_areas, self._closed_at)
        conductance = 0.0
        if open_.min() > _SHUT:
            vessel = float((self._resistances / open_**2).sum())
            conductance = 1.0 / (self._downstream + vessel)
        if self._time is None or time < self._time:
            self._pressure = self._rest_pressure
        elif self._reservoir:
            # The equation is linear: between two frames its solution is exact.
            rate = 1.0 + self._bed * conductance
            settled = self._source / rate
            left = math.exp(-rate * (time - self._time) / self._filling_time)
            self._pressure = settled + (self._pressure - settled) * left
        self._time = time
        return conductance * self._pressure
