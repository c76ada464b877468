"""The acoustics of one scanner: of its volume, its probe, and the mesh that carries the volume."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.beam_acoustics import SPEED_OF_SOUND, BeamAcoustics
from us_sim.slicing.acoustics.settings import Acoustics
from us_sim.slicing.formation.imaging import Imaging
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe
from us_sim.volume.volume import Volume

_F_NUMBER = 2.0  # of the aperture, over which a point is a wavelength times that wide
_PULSE_LENGTH = 1.5  # wavelengths of a point along the beam, 6 dB below its peak


class LiveAcoustics:
    """Makes what is left of echoes on their way, with the probe and the tissue as they are.

    Args:
        volume: its labels say what is where.
        probe: its geometry.
        acoustics: the settings.

    Raises:
        ProbeError: the volume has no labels, a label no constants, constants no label, or the probe
            not the frequency.
    """

    def __init__(self, volume: Volume, probe: Probe, acoustics: Acoustics) -> None:
        self._volume, self._probe, self._acoustics = volume, probe, acoustics
        self._beams = BeamAcoustics(volume, probe, acoustics)

    def resolved(self, imaging: Imaging) -> Imaging:
        """The console's settings with the blur of a frequency below the volume's own.

        A point is as long as the pulse and as wide as a wavelength times the f-number (Szabo 2014,
        section 6.6). What the volume's own frequency has blurred already is taken off in squares.
        """
        own = self._acoustics.volume_frequency
        frequency = self._acoustics.frequency_among(self._probe.frequencies)
        if own is None or frequency >= own:
            return imaging
        wavelength = SPEED_OF_SOUND * math.sqrt(1.0 / frequency**2 - 1.0 / own**2)
        return dataclasses.replace(
            imaging,
            lateral_resolution=min(
                math.hypot(imaging.lateral_resolution, _F_NUMBER * wavelength), 0.01
            ),
            axial_resolution=min(
                math.hypot(imaging.axial_resolution, _PULSE_LENGTH * wavelength), 0.01
            ),
        )

    def carry(self, rest_nodes: NDArray[np.float64], tetrahedra: NDArray[np.int32]) -> None:
        """Let this mesh carry the volume: (N, 3) m at rest, and (M, 4) indices into them."""
        self._beams.carry(rest_nodes, tetrahedra)

    def heard(self, frame: Frame) -> Callable[[NDArray[np.uint8]], NDArray[np.uint8]]:
        """What makes of a frame's echoes (rows, columns) what is left of them."""
        return lambda image: self._beams.heard(image, frame)

    def gain_on_pixels(self, frame: Frame) -> NDArray[np.float32]:
        """(rows, columns) dB that a frame's echoes are changed by, but for surfaces and noise."""
        return self._beams.gain_on_pixels(frame)

    def warm_up(self) -> None:
        """Load every kernel, and find the volume's surfaces."""
        blank = np.zeros((self._probe.rows, self._probe.columns), dtype=np.uint8)
        frame = Frame(Pose(), None, self._probe, self._volume, None, lambda _: blank)
        self.heard(frame)(blank)
