"""Why Doppler shows nothing, as far as it is known.

>>> from us_sim.slicing.flow.absence import Absence
>>> Absence("across_flow").name
'ACROSS_FLOW'
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from us_sim.slicing.flow.blood import Blood, Window
from us_sim.slicing.frame import Frame

_HEARD = 0.3  # coupling below which blood, 20 dB fainter than tissue, is lost
_STANDING = 1e-3  # m/s on a vessel's axis
_ACROSS = 0.12  # cosine between beam and flow: 83 degrees


class Absence(Enum):
    """Why no flow is seen in a part of the image; nothing where it should be seen."""

    NOTHING = ""
    NO_CONTACT = "no_contact"  # the beams there have no contact, or too little
    NO_VESSEL = "no_vessel"  # no lumen with a flow is there
    NO_FLOW = "no_flow"  # the vessel is closed
    ACROSS_FLOW = "across_flow"  # the beams are square to it
    TOO_SLOW = "too_slow"  # for the wall filter


def absence(
    blood: Blood, frame: Frame, window: Window, lines: NDArray[np.integer], wall_filter: float
) -> Absence:
    """Why flow cannot be seen at the places of a window.

    Args:
        blood: in it.
        lines: of the probe, as many as places in the window, whose echoes come from there.
        wall_filter: m/s.
    """
    coupling = np.ones(1) if frame.contact is None else frame.contact[0]
    heard = coupling[np.minimum(lines.ravel(), len(coupling) - 1)]
    if heard.max(initial=0.0) < _HEARD:
        return Absence.NO_CONTACT
    velocity, which = (each.ravel() for each in blood.mean_velocities(frame, window))
    within = which >= 0
    if not within.any():
        return Absence.NO_VESSEL
    if heard[within].max() < _HEARD:
        return Absence.NO_CONTACT
    cosine = fastest = speed = 0.0
    for number in np.unique(which[within]):
        vessel = blood.vessels[number]
        axis = float(np.linalg.norm(vessel.axis_velocity, axis=1).mean())
        along = float(np.abs(velocity[which == number]).max())
        speed = max(speed, axis)
        cosine = max(cosine, along / axis if axis > _STANDING else 0.0)
        # On the axis blood flows twice as fast as in the mean.
        peak = 0.5 * vessel.settings.peak_velocity / vessel.settings.mean_velocity
        fastest = max(fastest, along * peak)
    if speed < _STANDING:
        return Absence.NO_FLOW
    if cosine < _ACROSS:
        return Absence.ACROSS_FLOW
    return Absence.TOO_SLOW if fastest < wall_filter else Absence.NOTHING
