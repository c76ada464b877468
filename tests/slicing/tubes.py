"""Vessels whose flow is known: straight and bent tubes in volumes of nothing else."""

from __future__ import annotations

import numpy as np

from us_sim.slicing.flow.vessel import Vessel
from us_sim.slicing.settings import FlowSettings
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

RADIUS = 3e-3
SIDES = np.array([20e-3, 40e-3, 20e-3])
"""Of the volume, m, whose middle is the origin of x and y; z begins at 0."""

ARTERY = FlowSettings("arterial", (0, 1, 0), peak_velocity=0.8, mean_velocity=0.1)
VEIN = FlowSettings("venous", (0, -1, 0), peak_velocity=0.2, mean_velocity=0.07)


def grid(sides=SIDES, voxel=5e-4):
    """Places (i, j, k, 3) m of a volume's voxels, and its map from indices."""
    counts = np.rint(np.asarray(sides) / voxel).astype(int)
    to_patient = np.diag([voxel, voxel, voxel, 1.0])
    to_patient[:3, 3] = 0.5 * voxel - np.array([0.5 * sides[0], 0.5 * sides[1], 0.0])
    index = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1)
    return index @ to_patient[:3, :3].T + to_patient[:3, 3], to_patient


def around(places, start, direction, radius=RADIUS):
    """(i, j, k) which places lie within that distance of a line."""
    unit = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    offset = places - np.asarray(start)
    across = offset - (offset @ unit)[..., None] * unit
    return np.linalg.norm(across, axis=-1) < radius


def tube_volume(radius=RADIUS, direction=(0.0, 1.0, 0.0), voxel=5e-4):
    """A volume with a straight tube through its middle, label 1, ``vessel``."""
    places, to_patient = grid(voxel=voxel)
    lumen = around(places, (0.0, 0.0, 0.5 * SIDES[2]), direction, radius).astype(np.uint8)
    return Volume(lumen, to_patient, lumen, {1: "vessel"})


def tube_vessel(settings=VEIN, volume=None):
    """The vessel in it."""
    return Vessel("structures.vessel", volume or tube_volume(), 1, settings)


def block():
    """A mesh of the whole volume."""
    x, y = (uniform_planes(-0.5 * side, 0.5 * side, 11) for side in SIDES[:2])
    return box_mesh(x, y, uniform_planes(0.0, SIDES[2], 9))
