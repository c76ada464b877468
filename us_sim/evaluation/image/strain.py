"""Strain along the beams: of a block under a plate, of a stiff ball in it, and of an estimate.

The block is of Poisson's ratio 0, so that nothing is pushed aside, and it is strained by the
plate's depth over its height everywhere, whatever the law of elasticity. The ball's reference is
Hooke's law on quadratic tetrahedra, assembled by scikit-fem and solved by SciPy, for a quarter of
the block, on planes that are close together around the ball.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import dia_array

from us_sim.evaluation.block import EXTENT, MESHES, block, conjugate_gradients, graded_planes
from us_sim.evaluation.image.measure import Artefact, Point, tilted, voxel_grid, worst_percent
from us_sim.evaluation.report import ReportFolder, Target, filled, picture
from us_sim.evaluation.slice.cases import MAIN
from us_sim.evaluation.slice.cases import speckle as block_volume
from us_sim.evaluation.timing import medians_in_turn
from us_sim.geometry.collider import RoundedBox
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.drawing.annotation import Annotation
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.slicing.settings import Strain
from us_sim.slicing.strain import AxialStrain, displacement, strain_scale
from us_sim.slicing.strain_estimate import Estimate, estimate_strain
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import average_over_labels, label_fractions
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.tissue.model import TissueModel, face_nodes
from us_sim.tissue.solvers.solver import TissueSolver, create_solver
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]

PROBES: dict[str, Probe] = {
    "linear": LinearProbe(aperture=0.06, depth=0.08),
    "convex": ConvexProbe(radius=0.04, opening_angle=np.radians(60), depth=0.08),
    "sector": SectorProbe(aperture=0.02, opening_angle=np.radians(90), depth=0.08),
}
_SHOWN = "ball_3.2"
_PRESS = 0.002  # m, of 100, of a block with a ball
_FINE = 3e-3  # m, between the reference's planes around a ball


class StrainImages(Artefact):
    """Against closed forms, a fine mesh, and the estimate against the strain itself."""

    name, title = "strain", "Strain"

    def points(self, quick: bool) -> list[Point]:
        found = []
        for name, probe in PROBES.items():
            for degrees in (0.0, 40.0) if quick else (0.0, 10.0, 20.0, 30.0, 40.0):
                found += _block_rows(name, probe, degrees, MESHES[0 if quick else -1])
        for name in [*_BALLS][: 1 if quick else None]:
            found += _ball_rows(name, _BALLS[name], 6e-3 if quick else _FINE)
        found += compared_ball(_BALLS["ball_1.8" if quick else _SHOWN])
        return found + _time_rows(quick)

    def targets(self, points: Sequence[Point]) -> list[Target]:
        targets = []
        for artefact, what in (("strain_block", "strain"), ("displacement_block", "displacement")):
            worst = worst_percent([p for p in points if p.artefact == artefact])
            what += " of a homogeneous block under a plate, worst pixel, every probe"
            targets.append(Target.at_most(what, 2.0, worst, "%"))
        for point in points:
            if point.artefact.endswith("_sharp"):
                what = f"mean strain in a {point.artefact.split('_')[2]} times as stiff ball"
                error = abs(point.error_percent)
                targets.append(Target.at_most(f"{what}, borders sharp", 5.0, error, "%"))
        ms = {p.artefact: p.ms_median for p in points}
        what = "slice with strain, over the plain slice (2 ms over 0.9 ms are asked)"
        return [*targets, Target.at_most(what, 2.22, ms["strain_image"] / ms["strain_none"])]

    def report(self, points: Sequence[Point], folder: ReportFolder) -> str:
        _draw(folder.picture("strain"))
        balls, means, spread = [], [], []
        for p in points:
            measured, expected = f"{100 * p.measured:.3f} %", f"{100 * p.expected:.3f} %"
            if p.artefact.startswith("strain_ball"):
                error = f"{expected} in the reference ({p.error_percent:+.1f} %)."
                balls.append(f"`{p.artefact}`: {measured} on average, {error}")
            elif p.artefact == "strain_estimate_rms":
                error = f"{measured} of strain, {p.error_percent:.0f} % of that applied"
                spread.append(f"`{p.artefact}`: {error}; an estimate takes {p.ms_median:.0f} ms.")
            elif p.artefact.startswith("strain_estimate"):
                error = f"{expected} ({p.error_percent:+.1f} %)."
                means.append(f"`{p.artefact}`: {measured} where the strain is {error}")
        ms = {p.artefact: f"{p.ms_median:.2f}" for p in points}
        block_error = worst_percent([p for p in points if p.artefact == "strain_block"])
        return filled(
            "image",
            self.name,
            press=f"{100 * PRESS:g}",
            block_error=f"{block_error:.2g}",
            balls="\n\n".join(balls),
            fine=f"{1e3 * _FINE:g}",
            estimates="\n\n".join([*means, *spread]),
            none=ms["strain_none"],
            strain=ms["strain_image"],
            displacement=ms["strain_displacement"],
        )


def _block_rows(
    name: str, probe: Probe, degrees: float, counts: tuple[int, int, int]
) -> list[Point]:
    """The pixels with the greatest error of strain, and of axial displacement."""
    mesh, nodes = block(counts), pressed_block(counts)
    scanner = BMode(labelled(None), probe)
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    turn = tilted(degrees)
    frame = scanner.frame(Pose(np.array([0.0, 0.0, 0.02]), turn.orientation), nodes)
    deepest = PRESS * EXTENT[2][1]
    strain, moved = AxialStrain.of(frame).image(frame), displacement(frame)[..., 1]
    rows = []
    for artefact, found, expected, unit, whole in (
        ("strain_block", strain, beam_strain(frame), "", PRESS),
        ("displacement_block", moved, beam_displacement(frame)[..., 1], "m", deepest),
    ):
        error = np.where(np.isfinite(found), np.abs(found - expected), -1.0)
        at = np.unravel_index(int(error.argmax()), error.shape)
        depth = float(probe.pixel_beams[1][at])
        row = (artefact, name, degrees, depth, float(expected[at]), float(found[at]), unit)
        rows.append(Point.of(*row, of=whole))
    return rows


def _ball_rows(name: str, ball: Ball, size: float) -> list[Point]:
    """Mean strain in the ball: smooth, sharp, and of the tetrahedra themselves."""
    frame = ball_frame(ball, labelled(ball))
    inside = frame.labels == 2
    index = frame.located.rest_index()[inside]
    to_patient = frame.volume.index_to_patient
    rest = (index @ to_patient[:3, :3].T + to_patient[:3, 3])[::23]
    gradient = np.eye(3) + _PRESS * Reference(ball, size).gradient(rest)
    along = np.linalg.inv(gradient)[:, :, 2]  # where a unit along z now was
    expected = float(np.mean(1.0 / np.linalg.norm(along, axis=1) - 1.0))
    kinds: dict[str, NDArray[Any]] = {
        "": AxialStrain.of(frame).image(frame),
        "_sharp": AxialStrain.of(frame, sharp=True).image(frame),
        "_unsmoothed": _unsmoothed(frame),
    }
    return [
        Point.of(
            f"strain_{name}{kind}", "linear", 0.0, ball.centre[2], expected,
            float(np.mean(values[inside])), "",
        )
        for kind, values in kinds.items()
    ]  # fmt: skip


def ball_frame(ball: Ball, volume: Volume, press: float = _PRESS) -> Frame:
    """The ball's block under the plate, as a linear probe in the plate sees it."""
    mesh = ball_mesh(ball)
    scanner = BMode(volume, PROBES["linear"])
    scanner.carry(mesh.nodes, mesh.tetrahedra)
    return scanner.frame(Pose(np.array([0.0, 0.0, press])), ball_nodes(ball, press))


def _unsmoothed(frame: Frame) -> Array:
    """(rows, columns) along z, of the tetrahedron that each pixel lies in."""
    assert frame.mesh is not None
    rest, tetrahedra = frame.mesh
    elements, _, numbers = frame.located
    there = (elements >= 0) & (elements < len(numbers))
    shown = tetrahedra[numbers]
    now = np.asarray(frame.nodes, dtype=np.float64)[shown]
    edges, before = now[:, 1:] - now[:, :1], rest[shown][:, 1:] - rest[shown][:, :1]
    along = np.einsum("eij,ejk->eik", np.linalg.inv(edges), before)[:, 2]
    strain = 1.0 / np.linalg.norm(along, axis=1) - 1.0
    return np.where(there, strain[np.where(there, elements, 0)], np.nan)


def _time_rows(quick: bool) -> list[Point]:
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
    return [Point(f"strain_{name}", "linear", 0.0, ms_median=ms) for name, ms in medians.items()]


def _draw(file: Path) -> None:
    """B-mode, true strain and estimate of the ball, side by side."""
    frame, strain, estimate, _ = _estimated(_BALLS[_SHOWN])
    annotation = Annotation(frame.probe, {2: ("stiff", (0.9, 0.9, 0.9))})
    views = {"B-mode": None, "strain": strain, "estimate": estimate.strain}
    title = "A ball 3.2 times as stiff as what is around it, pressed by 1 %"
    with picture(file, 10.0, 4.9, title) as figure:
        for panel, (name, values) in zip(figure.subplots(1, 3), views.items(), strict=True):
            overlay = None
            if values is not None:
                overlay = Overlay(values, strain_scale("strain", 0.02), opacity=0.6)
            image = annotation.draw(frame.pixels, frame.labels, overlay=overlay)
            lateral, axial = frame.probe.pixel_spacing
            panel.imshow(image, aspect=axial / lateral)
            panel.set_title(name, fontsize=10)
            panel.set_axis_off()


PLATE = RoundedBox(length=0.4, width=0.3, height=0.05, rounding=0.001)
"""Larger than the block's top."""


@dataclass(frozen=True)
class Ball:
    """A ball that is stiffer than its surroundings."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.045)  # m
    radius: float = 0.018  # m
    stiffer: float = 3.0
    poisson_ratio: float = 0.45  # of both

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Which of points (…, 3) m lie in it."""
        return np.asarray(np.linalg.norm(points - np.array(self.centre), axis=-1) <= self.radius)


_BALLS = {"ball_1.8": Ball(stiffer=1.8), "ball_3.2": Ball(stiffer=3.2)}
"""As stiff as the third and fourth kind of lesion of the phantom CIRS 049 (45 and 80 in 25 kPa)."""


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
def ball_mesh(ball: Ball) -> TetrahedralMesh:
    """As many tetrahedra as the finest of the paper's meshes, with planes closer in the ball."""
    half = ball.radius + 0.5e-3
    planes: list[Array] = []
    for (low, high), centre, count in zip(EXTENT, ball.centre, (15, 9, 9), strict=True):
        fine = np.linspace(centre - half, centre + half, count + 1)
        outside = (MESHES[-1][len(planes)] - count - 1) // 2
        size = 2.0 * half / count
        planes.append(
            np.concatenate(
                [
                    fine[0] - _growing(fine[0] - low, size, outside)[::-1],
                    fine,
                    fine[-1] + _growing(high - fine[-1], size, outside),
                ]
            )
        )
        planes[-1][[0, -1]] = low, high
    return box_mesh(*planes)


def _growing(length: float, size: float, count: int) -> Array:
    """Where planes lie whose distances grow from ``size`` on and fill a length, by bisection."""
    least, most = 0.1, 10.0
    for _ in range(60):
        growth = (least * most) ** 0.5
        far = size * (growth ** np.arange(1, count + 1)).sum() > length
        least, most = (least, growth) if far else (growth, most)
    return np.asarray(size * np.cumsum(growth ** np.arange(1, count + 1)))


@cache
def ball_nodes(ball: Ball, depth: float) -> Array:
    """(N, 3) m, of that mesh with the ball in it, under the plate."""
    return pressed_by_plate(_ball_solver(ball), depth)


@cache
def _ball_solver(ball: Ball) -> TissueSolver:
    soft = Material(10e3, ball.poisson_ratio, 1000.0)
    stiff = Material(10e3 * ball.stiffer, ball.poisson_ratio, 1000.0)
    return create_solver("fem", plate_model(ball_mesh(ball), soft, stiff, labelled(ball)))


class Reference:
    """The linear solution on a fine mesh, for a unit of depth.

    Args:
        ball: in the block.
        size: m, between planes around the ball.

    Raises:
        SolverError: SciPy's conjugate gradients did not converge.
    """

    def __init__(self, ball: Ball, size: float) -> None:
        from skfem import Basis, BilinearForm, ElementTetP2, ElementVector, MeshTet
        from skfem.helpers import ddot, div, sym_grad

        (_, across), (_, along), (_, deep) = EXTENT
        near = ball.radius + size
        z = ball.centre[2]
        mesh = box_mesh(
            graded_planes(0.0, across, 0.0, near, size, 1.5),
            graded_planes(0.0, along, 0.0, near, size, 1.5),
            graded_planes(0.0, deep, z - near, z + near, size, 1.5),
        )
        self._mesh = MeshTet(*map(np.ascontiguousarray, (mesh.nodes.T, mesh.tetrahedra.T)))
        self._basis = Basis(self._mesh, ElementVector(ElementTetP2()))
        ratio = ball.poisson_ratio

        @BilinearForm
        def elasticity(u, v, w):  # type: ignore[no-untyped-def]
            young = np.where(ball.holds(np.moveaxis(w.x, 0, -1)), ball.stiffer, 1.0)
            shear = 0.5 * young / (1.0 + ratio)
            bulk = young * ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio))
            return 2.0 * shear * ddot(sym_grad(u), sym_grad(v)) + bulk * div(u) * div(v)

        matrix = elasticity.assemble(self._basis).tocsr()
        # Of a quarter: nothing crosses the planes of symmetry; the floor holds, the plate slides.
        held = np.unique(
            np.concatenate(
                [
                    self._on(0, 0.0, "u^1"),
                    self._on(1, 0.0, "u^2"),
                    *(self._on(2, deep, component) for component in ("u^1", "u^2", "u^3")),
                ]
            )
        )
        top = self._on(2, 0.0, "u^3")
        self._unit = np.zeros(matrix.shape[0])
        self._unit[top] = 1.0
        free = np.setdiff1d(np.arange(matrix.shape[0]), np.concatenate([held, top]))
        inner = matrix[free][:, free]
        right = -(matrix @ self._unit)[free]
        over = dia_array((1.0 / inner.diagonal()[None], [0]), shape=inner.shape)
        self._unit[free] = conjugate_gradients(inner, right, 1e-8, over, 20_000)

    def gradient(self, points: Array) -> Array:
        """(P, 3, 3) the displacement's gradient per m of depth, at points (P, 3) m at rest."""
        signs = np.where(points[:, :2] < 0.0, -1.0, 1.0)
        mirror = np.column_stack([signs, np.ones(len(points))])
        places = (points * mirror).T
        cells = self._mesh.element_finder()(*places)
        local = self._mesh.mapping().invF(places[:, :, None], tind=cells)
        gradient = np.zeros((len(points), 3, 3))
        for i in range(self._basis.Nbfun):
            field = self._basis.elem.gbasis(self._basis.mapping, local, i, tind=cells)[0]
            weight = self._unit[self._basis.element_dofs[i, cells]]
            gradient += weight[:, None, None] * np.moveaxis(field.grad[..., 0], -1, 0)
        return gradient * mirror[:, :, None] * mirror[:, None, :]

    def _on(self, axis: int, place: float, component: str) -> NDArray[np.intp]:
        facets = self._mesh.facets_satisfying(lambda x: np.isclose(x[axis], place))
        return np.asarray(self._basis.get_dofs(facets).all(component))


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


def compared_ball(ball: Ball) -> list[Point]:
    """Means inside and outside of the ball, and the error of all pixels."""
    frame, strain, estimate, ms = _estimated(ball)
    places = frame.located.rest_index()
    to_patient = frame.volume.index_to_patient
    rest = places @ to_patient[:3, :3].T + to_patient[:3, 3]
    away = np.linalg.norm(rest - np.array(ball.centre), axis=-1) - ball.radius
    found = np.isfinite(estimate.strain) & np.isfinite(strain)
    rows = []
    margin = 4e-3  # m, around the border of the ball that belongs to neither side
    for name, part in (("inside", away < -margin), ("outside", away > margin)):
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
