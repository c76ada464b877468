"""Compiling what displacement and strain need, or loading it, by way of a tiny image."""

from __future__ import annotations

from functools import cache

import numpy as np

from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.displacement import displacement
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.slicing.strain.axial_strain import AxialStrain
from us_sim.slicing.strain.tracking import track
from us_sim.volume.volume import Volume


@cache
def warm_up() -> None:
    """So that the first image is not late; once in a process."""
    voxels = np.zeros((2, 2, 2), dtype=np.uint8)
    nodes = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]]) - 2e-4
    scanner = BMode(
        Volume(voxels, np.eye(4)), LinearProbe(aperture=0.01, depth=0.01, columns=4, rows=4)
    )
    scanner.carry(nodes, np.array([[0, 1, 2, 3]]))
    frame = scanner.frame(Pose(), 1.1 * nodes)
    displacement(frame)
    track(np.zeros((40, 4)), np.zeros((40, 4)), window=(3, 3), search=1)
    AxialStrain.of(frame).image(frame)
