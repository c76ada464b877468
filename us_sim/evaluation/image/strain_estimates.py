"""The estimate of two images of a ball under a plate, against the strain itself."""

from __future__ import annotations

import time
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.evaluation.image.inclusion import Ball, ball_mesh, ball_nodes
from us_sim.evaluation.image.points import Point
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.slicing.settings import Strain
from us_sim.slicing.strain import AxialStrain
from us_sim.slicing.strain_estimate import Estimate, estimate_strain
from us_sim.volume.volume import Volume

_PROBE = LinearProbe(aperture=0.06, depth=0.08)
_FIRST, _SECOND = 0.001, 0.002  # m, the plate's depth in the two images
_SETTINGS = Strain(search=1.5e-3)
_SLAB = ((-0.034, 0.034), (-0.004, 0.004), (0.0, 0.09))  # m, that the probe can see
_VOXEL = (0.2e-3, 0.4e-3, 0.15e-3)  # m
_MARGIN = 4e-3  # m, around the border of the ball that belongs to neither side


def speckled(ball: Ball, seed: int = 1) -> Volume:
    """Speckle of a scanner of some 7 MHz in a slab around the image, and labels as `labelled`."""
    counts = [round((high - low) / step) for (low, high), step in zip(_SLAB, _VOXEL, strict=True)]
    generator = np.random.default_rng(seed)
    echoes = generator.standard_normal((2, *counts), dtype=np.float32)
    # The envelope of complex Gaussian noise is Rayleigh distributed, as fully developed speckle is.
    envelope = np.hypot(*(ndimage.gaussian_filter(part, (2.0, 1.5, 1.2)) for part in echoes))
    decibels = 20.0 * np.log10(np.maximum(envelope / envelope.mean(), 1e-3))
    grey = np.clip(np.rint(150.0 + 255.0 / 60.0 * decibels), 0, 255).astype(np.uint8)
    to_patient = np.diag([*_VOXEL, 1.0])
    to_patient[:3, 3] = [low + 0.5 * step for (low, _), step in zip(_SLAB, _VOXEL, strict=True)]
    places = np.moveaxis(np.indices(counts), 0, -1) * np.array(_VOXEL) + to_patient[:3, 3]
    labels = np.where(ball.holds(places), 2, 1).astype(np.uint8)
    return Volume(grey, to_patient, labels, {1: "soft", 2: "stiff"})


@cache
def _estimated(ball: Ball) -> tuple[Frame, NDArray[np.float32], Estimate, float]:
    """The second frame, the strain between both, the estimate, and its ms."""
    mesh = ball_mesh(ball)
    scanner = BMode(speckled(ball), _PROBE)
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    first, second = (
        scanner.frame(Pose(np.array([0.0, 0.0, depth])), ball_nodes(ball, depth))
        for depth in (_FIRST, _SECOND)
    )
    strain = AxialStrain.of(second).image(second, first.nodes)
    taken = []
    for _ in range(5):
        began = time.thread_time()
        estimate = estimate_strain(first.pixels, second.pixels, _PROBE, _SETTINGS)
        taken.append(1e3 * (time.thread_time() - began))
    return second, strain, estimate, float(np.median(taken))


def comparison(ball: Ball) -> tuple[Frame, NDArray[np.float32], NDArray[np.float32]]:
    """The second frame, the strain since the first, and the estimate of it."""
    frame, strain, estimate, _ = _estimated(ball)
    return frame, strain, estimate.strain


def compared_ball(ball: Ball) -> list[Point]:
    """Means inside and outside of the ball, and the error of all pixels."""
    frame, strain, estimate, ms = _estimated(ball)
    places = frame.located.rest_index()
    to_patient = frame.volume.index_to_patient
    rest = places @ to_patient[:3, :3].T + to_patient[:3, 3]
    away = np.linalg.norm(rest - np.array(ball.centre), axis=-1) - ball.radius
    found = np.isfinite(estimate.strain) & np.isfinite(strain)
    rows = []
    for name, part in (("inside", away < -_MARGIN), ("outside", away > _MARGIN)):
        mine = found & part
        rows.append(
            Point.of(
                f"strain_estimate_{name}", "linear", 0.0, ball.centre[2],
                float(strain[mine].mean()), float(estimate.strain[mine].mean()), "",
            )
        )  # fmt: skip
    error = float(np.sqrt(np.mean(np.square(estimate.strain[found] - strain[found]))))
    applied = abs(float(strain[found].mean()))
    rows.append(
        Point.of(
            "strain_estimate_rms", "linear", 0.0, ball.centre[2], 0.0, error, "", of=applied, ms=ms
        )
    )
    return rows
