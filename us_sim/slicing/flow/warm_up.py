"""Compiling what shows blood, or loading it from numba's cache, before it is needed."""

from __future__ import annotations

import numpy as np

from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.colour_doppler import ColourDoppler
from us_sim.slicing.flow.colour_settings import ColourSettings
from us_sim.slicing.flow.settings import FlowSettings
from us_sim.slicing.flow.spectrum import Spectrum
from us_sim.slicing.flow.spectrum_settings import SpectrumSettings
from us_sim.slicing.flow.vessel import Vessel
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.volume import Volume


def warm_up() -> None:
    """Use every kernel of this room once, on a tube of a few voxels."""
    x, z = np.meshgrid(np.arange(9) - 4, np.arange(9) - 4, indexing="ij")
    tube = np.repeat((x**2 + z**2 < 10)[:, None], 40, axis=1).astype(np.uint8)
    volume = Volume(tube, np.diag([1e-3, 1e-3, 1e-3, 1.0]), tube, {1: "vessel"})
    flow = FlowSettings("arterial", (0.0, 1.0, 0.0), peak_velocity=0.5, mean_velocity=0.1)
    blood = Blood([Vessel("vessel", volume, 1, flow)])
    # Part of the tube lies outside.
    mesh = box_mesh([1e-3, 8e-3], [0.0, 0.02, 0.03], [0.0, 8e-3])
    probe = LinearProbe(aperture=8e-3, depth=8e-3, columns=8, rows=8)
    scanner = BMode(volume, probe)
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    colour = ColourDoppler(probe, ColourSettings(width=1.0))
    spectrum = Spectrum(probe, SpectrumSettings())
    for nodes in (None, mesh.nodes):
        frame = scanner.frame(Pose(np.array([4e-3, 0.02, 0.0])), nodes, time=1.0)
        colour.estimate(blood, frame)
        spectrum.columns(blood, frame, np.array([1.0]))
