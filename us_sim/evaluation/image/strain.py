"""Strain along the beams: of a block under a plate, of a stiff ball in it, and of an estimate.

The block is of Poisson's ratio 0, so that nothing is pushed aside, and it is strained by the
plate's depth over its height everywhere, whatever the law of elasticity.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.evaluation.block import EXTENT, MESHES, block
from us_sim.evaluation.image.measure import row_of, tilted, time_row, voxel_grid
from us_sim.evaluation.slice.cases import MAIN
from us_sim.evaluation.slice.cases import speckle as block_volume
from us_sim.evaluation.timing import medians_in_turn
from us_sim.geometry.collider import RoundedBox
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.slicing.settings import Strain
from us_sim.slicing.strain import AxialStrain, displacement
from us_sim.slicing.strain_estimate import Estimate, estimate_strain
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import average_over_labels, label_fractions
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import TissueModel, face_nodes
from us_sim.tissue.solvers.solver import TissueSolver, create_solver
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]
Row: TypeAlias = "dict[str, Any]"

PROBES: dict[str, Probe] = {
    "linear": LinearProbe(aperture=0.06, depth=0.08),
    "convex": ConvexProbe(radius=0.04, opening_angle=np.radians(60), depth=0.08),
    "sector": SectorProbe(aperture=0.02, opening_angle=np.radians(90), depth=0.08),
}
_PRESS = 0.002  # m, of 100, of a block with a ball


def strain_rows(quick: bool) -> Iterator[Row]:
    """Against closed forms, a fine mesh, and the estimate against the strain itself."""
    for name, probe in PROBES.items():
        for degrees in (0.0, 40.0) if quick else (0.0, 10.0, 20.0, 30.0, 40.0):
            yield from _block_rows(name, probe, degrees, MESHES[0 if quick else -1])
    yield from compared_ball(Ball())
    yield from _time_rows(quick)


def _block_rows(
    name: str, probe: Probe, degrees: float, counts: tuple[int, int, int]
) -> Iterator[Row]:
    """The pixels with the greatest error of strain, and of axial displacement."""
    mesh, nodes = block(counts), pressed_block(counts)
    scanner = BMode(labelled(None), probe)
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    turn = tilted(degrees)
    frame = scanner.frame(Pose(np.array([0.0, 0.0, 0.02]), turn.orientation), nodes)
    deepest = PRESS * EXTENT[2][1]
    strain, moved = AxialStrain.of(frame).image(frame), displacement(frame)[..., 1]
    for artefact, found, expected, unit, whole in (
        ("strain_block", strain, beam_strain(frame), "", PRESS),
        ("displacement_block", moved, beam_displacement(frame)[..., 1], "m", deepest),
    ):
        error = np.where(np.isfinite(found), np.abs(found - expected), -1.0)
        at = np.unravel_index(int(error.argmax()), error.shape)
        depth = float(probe.pixel_beams[1][at])
        row = (artefact, name, degrees, depth, float(expected[at]), float(found[at]), unit)
        yield row_of(*row, of=whole)


def ball_frame(ball: Ball, volume: Volume, press: float = _PRESS) -> Frame:
    """The ball's block under the plate, as a linear probe in the plate sees it."""
    mesh = block(MESHES[-1])
    scanner = BMode(volume, PROBES["linear"])
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    return scanner.frame(Pose(np.array([0.0, 0.0, press])), ball_nodes(ball, press))


def _time_rows(quick: bool) -> Iterator[Row]:
    """Processor time of one thread for an image, plain, with strain and with displacement."""
    mesh, frames = MAIN.mesh(), MAIN.frames(4)
    scanner = BMode(block_volume(), PROBES["linear"])
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    strain = AxialStrain(mesh.nodes, mesh.tetrahedra)
    work: dict[str, Callable[[Frame], object]] = {
        "none": lambda frame: frame.pixels,
        "image": lambda frame: (frame.pixels, strain.image(frame)),
        "displacement": lambda frame: (frame.pixels, displacement(frame)),
    }

    def frame_of(number: int) -> Frame:
        return scanner.frame(Pose(np.array([0.0, 0.0, 0.012])), frames[number % 4].nodes)

    medians = medians_in_turn(work, 22 if quick else 82, 2, prepare=frame_of)
    for name, ms in medians.items():
        yield time_row(f"strain_{name}", ms, 0.0)


PLATE = RoundedBox(length=0.4, width=0.3, height=0.05, rounding=0.001)
"""Larger than the block's top."""


@dataclass(frozen=True)
class Ball:
    """A ball that is stiffer than its surroundings."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.045)  # m
    radius: float = 0.018  # m
    stiffer: float = 3.2  # as the fourth kind of lesion of the phantom CIRS 049, 80 in 25 kPa
    poisson_ratio: float = 0.45  # of both

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Which of points (…, 3) m lie in it."""
        return np.asarray(np.linalg.norm(points - np.array(self.centre), axis=-1) <= self.radius)


def plate_model(
    mesh: TetrahedralMesh, soft: Material, stiff: Material, labels: Volume
) -> TissueModel:
    """The block on a floor that holds it, below a plate; label 2 is the stiff material."""
    assert labels.labels is not None
    fractions = label_fractions(mesh, labels.labels, labels.patient_to_index)
    return TissueModel(
        mesh=mesh,
        materials=average_over_labels(fractions, {1: soft, 2: stiff}),
        fixed=np.isin(np.arange(len(mesh.nodes)), face_nodes(mesh, "bottom")),
        collider=PLATE,
        contact_nodes=face_nodes(mesh, "top"),
    )


def pressed_by_plate(solver: TissueSolver, depth: float) -> Array:
    """(N, 3) m, the nodes with the plate ``depth`` m below the top, once nothing moves."""
    pose = Pose(np.array([0.0, 0.0, depth]))
    for _ in range(200):
        deformation = solver.deform(pose)
        if solver.deform(pose) is deformation:
            break
    return deformation.nodes


def labelled(ball: Ball | None) -> Volume:
    """The block without echoes in voxels of 1 mm: label 2 in the ball, 1 elsewhere."""
    counts, to_patient = voxel_grid(EXTENT, 3 * [1e-3])
    labels = np.ones(counts, dtype=np.uint8)
    if ball is not None:
        places = np.moveaxis(np.indices(counts), 0, -1) * 1e-3 + to_patient[:3, 3]
        labels[ball.holds(places)] = 2
    names = {1: "soft", 2: "stiff"}
    return Volume(np.zeros(counts, np.uint8), to_patient, labels, names)


@cache
def ball_nodes(ball: Ball, depth: float) -> Array:
    """(N, 3) m, of that mesh with the ball in it, under the plate."""
    return pressed_by_plate(_ball_solver(ball), depth)


@cache
def _ball_solver(ball: Ball) -> TissueSolver:
    soft = Material(10e3, ball.poisson_ratio, 1000.0)
    stiff = Material(10e3 * ball.stiffer, ball.poisson_ratio, 1000.0)
    return create_solver("fem", plate_model(block(MESHES[-1]), soft, stiff, labelled(ball)))


PRESS = 0.05  # of the height


@cache
def pressed_block(counts: tuple[int, int, int]) -> Array:
    """(N, 3) m, the nodes of the block's mesh with so many of them along each axis."""
    material = Material(10e3, 0.0, 1000.0)
    model = plate_model(block(counts), material, material, labelled(None))
    return pressed_by_plate(create_solver("fem", model), PRESS * EXTENT[2][1])


def beam_displacement(frame: Frame) -> Array:
    """(rows, columns, 2) m, lateral and axial: on the floor nothing moves, at the plate all."""
    floor = EXTENT[2][1]
    down = PRESS * (floor - frame.plane.pixels()[..., 2]) / (1.0 - PRESS)
    return np.asarray(down[..., None] * frame.pose.rotation[2, [0, 2]])


def beam_strain(frame: Frame) -> Array:
    """(rows, columns): a line along the beam now was |F⁻¹ d| as long, with F = diag(1, 1, 0.95)."""
    x, z = frame.probe.pixel_directions.astype(np.float64)
    directions = np.stack([x, np.zeros_like(x), z], axis=-1) @ frame.pose.rotation.T
    before = directions / np.array([1.0, 1.0, 1.0 - PRESS])
    return np.asarray(1.0 / np.linalg.norm(before, axis=-1) - 1.0)


def speckled(ball: Ball, seed: int = 1) -> Volume:
    """Speckle of a scanner of some 7 MHz in the slab that the probe sees, labelled as the block."""
    voxel = (0.2e-3, 0.4e-3, 0.15e-3)  # m
    slab = ((-0.034, 0.034), (-0.004, 0.004), (0.0, 0.09))
    counts, to_patient = voxel_grid(slab, voxel)
    generator = np.random.default_rng(seed)
    echoes = generator.standard_normal((2, *counts), dtype=np.float32)
    # The envelope of complex Gaussian noise is Rayleigh distributed, as fully developed speckle is.
    envelope = np.hypot(*(ndimage.gaussian_filter(part, (2.0, 1.5, 1.2)) for part in echoes))
    decibels = 20.0 * np.log10(np.maximum(envelope / envelope.mean(), 1e-3))
    grey = np.clip(np.rint(150.0 + 255.0 / 60.0 * decibels), 0, 255).astype(np.uint8)
    places = np.moveaxis(np.indices(counts), 0, -1) * np.array(voxel) + to_patient[:3, 3]
    labels = np.where(ball.holds(places), 2, 1).astype(np.uint8)
    return Volume(grey, to_patient, labels, {1: "soft", 2: "stiff"})


@cache
def _estimated(ball: Ball) -> tuple[Frame, NDArray[np.float32], Estimate, float]:
    """The second frame, the strain between both, the estimate, and its ms."""
    probe, volume = PROBES["linear"], speckled(ball)
    first, second = (ball_frame(ball, volume, depth) for depth in (0.001, 0.002))  # m
    strain = AxialStrain.of(second).image(second, first.nodes)
    taken = []
    for _ in range(5):
        began = time.thread_time()
        estimate = estimate_strain(first.pixels, second.pixels, probe, Strain(search=1.5e-3))
        taken.append(1e3 * (time.thread_time() - began))
    return second, strain, estimate, float(np.median(taken))


def compared_ball(ball: Ball) -> Iterator[Row]:
    """Means inside and outside of the ball, and the error of all pixels."""
    frame, strain, estimate, ms = _estimated(ball)
    places = frame.located.rest_index()
    to_patient = frame.volume.index_to_patient
    rest = places @ to_patient[:3, :3].T + to_patient[:3, 3]
    away = np.linalg.norm(rest - np.array(ball.centre), axis=-1) - ball.radius
    found = np.isfinite(estimate.strain) & np.isfinite(strain)
    margin = 4e-3  # m, around the border of the ball that belongs to neither side
    for name, part in (("inside", away < -margin), ("outside", away > margin)):
        mine = found & part
        means = float(strain[mine].mean()), float(estimate.strain[mine].mean())
        yield row_of(f"strain_estimate_{name}", "linear", 0.0, ball.centre[2], *means, "")
    error = float(np.sqrt(np.mean(np.square(estimate.strain[found] - strain[found]))))
    row = ("strain_estimate_rms", "linear", 0.0, ball.centre[2], 0.0, error, "")
    images = {"B-mode": frame.pixels, "strain": strain, "estimate": estimate.strain}
    yield {**row_of(*row, of=abs(float(strain[found].mean())), ms=ms), "images": images}
