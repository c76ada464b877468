"""A homogeneous block under a plate, and the strain that each beam should meet in it.

With Poisson's ratio 0 nothing is pushed aside, so that a block that its floor holds is strained by
the plate's depth over its height everywhere, whatever the law of elasticity.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.block import EXTENT, block
from us_sim.evaluation.image.inclusion import labelled, plate_model, pressed_by_plate
from us_sim.slicing.frame import Frame
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.solvers.solver import create_solver

PRESS = 0.05
"""Of the height."""


@cache
def pressed_block(counts: tuple[int, int, int]) -> NDArray[np.float64]:
    """(N, 3) m, the nodes of the block's mesh with so many of them along each axis."""
    material = Material(10e3, 0.0, 1000.0)
    model = plate_model(block(counts), material, material, labelled(None))
    return pressed_by_plate(create_solver("fem", model), PRESS * EXTENT[2][1])


def beam_displacement(frame: Frame) -> NDArray[np.float64]:
    """(rows, columns, 2) m, lateral and axial: on the floor nothing moves, at the plate all."""
    floor = EXTENT[2][1]
    down = PRESS * (floor - frame.plane.pixels()[..., 2]) / (1.0 - PRESS)
    return np.asarray(down[..., None] * frame.pose.rotation[2, [0, 2]])


def beam_strain(frame: Frame) -> NDArray[np.float64]:
    """(rows, columns): a line along the beam now was |F⁻¹ d| as long, with F = diag(1, 1, 0.95)."""
    x, z = frame.probe.pixel_directions.astype(np.float64)
    directions = np.stack([x, np.zeros_like(x), z], axis=-1) @ frame.pose.rotation.T
    before = directions / np.array([1.0, 1.0, 1.0 - PRESS])
    return np.asarray(1.0 / np.linalg.norm(before, axis=-1) - 1.0)
