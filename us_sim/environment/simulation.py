"""A scene as one object without ROS: a pose of the probe in, image, forces and every truth out.

It makes the same objects as the nodes do in lockstep, and calls them in the same order. Frames are
counted in iterations and on one thread, so that the same poses give the same bytes.

>>> from us_sim.environment.simulation import ScanSimulation
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.scene.reading import load_scene
>>> simulation = ScanSimulation(load_scene("tests/small_scene.yaml"))
>>> state = simulation.step(Pose([0.0, 0.0, 0.006]))
>>> state.image.shape, bool(state.force > 1.0)  # N
((80, 96), True)
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from us_sim.errors import SceneError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_exp
from us_sim.progress import late_progress
from us_sim.scene.building import (
    build_materials,
    build_membrane,
    build_scanner,
    build_tissue_model,
    compute_label_fractions,
    load_volume,
)
from us_sim.scene.episode import DrawRanges
from us_sim.scene.scene import Scene
from us_sim.settings.registry import SOLVERS
from us_sim.skin.membrane import SkinMembrane
from us_sim.slicing.acoustics.surface_echo import find_surface_normals
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import lift_probe
from us_sim.slicing.strain import AxialStrain, compute_displacement
from us_sim.tissue.elasticity.material import guess_tissue_kind
from us_sim.tissue.elasticity.materials import LabelFractions
from us_sim.tissue.live_tissue import compile_solver
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import TissueSolver
from us_sim.volume.volume import Volume

_VOLUMES = 4
"""Number of volumes, of other speckle, that are kept with their tissue."""


@dataclass(frozen=True, eq=False)
class EpisodeDraw:
    """An episode's values, drawn from `DrawRanges`; the defaults leave the scene as it is."""

    stiffness: Mapping[str, float] = field(default_factory=dict)  # factor by label; else 1
    lumen_pressure: float = 1.0  # factor
    thickness: float = 1.0  # factor
    start: Pose = field(default_factory=Pose)  # in ``patient``
    gain: float = 0.0  # dB, added to the scene's
    speckle: int | None = None  # seed of the phantom; None for the scene's
    position_noise: float = 0.0  # m
    orientation_noise: float = 0.0  # rad
    delay: int = 0  # steps

    @classmethod
    def sample_values(
        cls, draws: DrawRanges, scene: Scene, random: np.random.Generator
    ) -> EpisodeDraw:
        """Draw the values; the ranges do not change how many random numbers are taken."""

        def sample_linear(name: str, count: int | None = None) -> Any:
            low, high = getattr(draws, name)
            return random.uniform(low, high, count)

        def sample_factor(name: str, count: int | None = None) -> Any:
            low, high = np.log(getattr(draws, name))
            return np.exp(random.uniform(low, high, count))

        labels = sorted(scene.tissue.materials) if scene.tissue else []
        stiffness = dict(zip(labels, sample_factor("stiffness", len(labels)).tolist(), strict=True))
        lumen_pressure = float(sample_factor("lumen_pressure"))
        thickness = float(sample_linear("thickness"))
        place = [sample_linear("lateral"), sample_linear("elevational"), -sample_linear("height")]
        turn = np.array([*sample_linear("tilt", 2), sample_linear("rotation")])
        gain = float(sample_linear("gain"))
        speckle = int(random.integers(*draws.speckle, endpoint=True))
        noise = float(sample_linear("position_noise")), float(sample_linear("orientation_noise"))
        delay = int(random.integers(*draws.delay, endpoint=True))
        start = Pose(np.array(place), rotation_exp(turn))
        seed = speckle if scene.volume.phantom is not None else None
        return cls(stiffness, lumen_pressure, thickness, start, gain, seed, *noise, delay)

    def to_document(self) -> dict[str, Any]:
        """Return the values for JSON, in SI units."""
        start = [*self.start.position.tolist(), *self.start.orientation.tolist()]
        return {**vars(self), "stiffness": dict(self.stiffness), "start": start}


@dataclass(eq=False)
class ScanState:
    """A pose of the probe, and its frame and forces; images are made when asked for."""

    pose: Pose  # of the probe, true
    frame: Frame
    wrench: NDArray[np.float64]  # (6,) N, N m, of the tissue on the probe, frame ``probe``
    is_balanced: bool  # else the wrench is an earlier state's
    strains: AxialStrain | None = None

    @property
    def force(self) -> float:
        """Force (N) by which the tissue pushes the probe back along its axis."""
        return -float(self.wrench[2])

    @cached_property
    def contact(self) -> float:
        """Part of the face that touches, 0 to 1; without air in the scene, 1 if a force acts."""
        contact = self.frame.contact
        return float(self.wrench.any()) if contact is None else float(contact[0].mean())

    @property
    def image(self) -> NDArray[np.uint8]:
        """(rows, columns) B-mode."""
        return self.frame.pixels

    @property
    def labels(self) -> NDArray[np.uint8]:
        """(rows, columns) label of each pixel, 0 for none."""
        return self.frame.labels

    @cached_property
    def displacement(self) -> NDArray[np.float32]:
        """(rows, columns, 2) m, lateral and axial displacement from rest; 0 outside tissue."""
        return np.nan_to_num(compute_displacement(self.frame))

    @cached_property
    def strain(self) -> NDArray[np.float32]:
        """(rows, columns) axial strain against rest; 0 outside tissue."""
        assert self.strains is not None
        return np.nan_to_num(self.strains.compute_strain(self.frame))


@dataclass(frozen=True, eq=False)
class SimulationSnapshot:
    """All that decides the states of a simulation for the poses to come."""

    draw: EpisodeDraw
    solver: TissueSolver | None
    membrane: SkinMembrane | None
    wrench: NDArray[np.float64]
    number: int  # of poses so far


class ScanSimulation:
    """The tissue, the skin and the scanner of a scene, as a draw changes them.

    Raises:
        UsSimError: a part of the scene cannot be made.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._blas = ThreadpoolController()
        self._volumes: dict[int | None, tuple[Volume, TissueModel | None, Any]] = {}
        self._normals: dict[int | None, Any] = {}  # kept for thicker and thinner layers
        self._shape: tuple[Any, ...] | None = None
        self._materials: tuple[Any, ...] | None = None
        self._solver: TissueSolver | None = None
        self._membrane = build_membrane(scene) if scene.skin and scene.imaging.contact else None
        self._strains: AxialStrain | None = None
        self._mesh: TetrahedralMesh
        self.scanner: BMode
        self.volume: Volume
        self.reset()

    @property
    def pixel_area(self) -> float:
        """Area of a pixel, m²."""
        return float(np.prod(self.scanner.probe.pixel_spacing))

    def find_label(self, name: str | None) -> int:
        """Return the number of the label of a name; of the first vein if it is None.

        Raises:
            SceneError: the volume has no such label.
        """
        names = self.volume.label_names if self.volume.labels is not None else {}
        for number, each in names.items():
            if each == name or (name is None and guess_tissue_kind(each) == "vein"):
                return number
        what = f"label `{name}`" if name else "vein"
        has = ", ".join(names.values()) or "no labels"
        raise SceneError(
            f"{self.scene.origin}: episode.target: the volume has no {what}; it has {has}: name "
            f"another scene or label"
        )

    def reset(self, draw: EpisodeDraw | None = None) -> None:
        """Bring the tissue to rest with no probe near, and rebuild what a draw changes.

        Raises:
            UsSimError: the volume or the tissue cannot be made.
        """
        self._draw = draw = draw or EpisodeDraw()
        with self._blas.limit(limits=1, user_api="blas"):
            shape = draw.speckle, draw.thickness
            materials = *shape, draw.lumen_pressure, dict(draw.stiffness)
            last = self._shape, self._materials
            self._shape = self._materials = None  # where something cannot be made
            if shape != last[0]:
                self._make_scanner(draw)
            if materials != last[1]:
                self._make_tissue(draw)
            elif self._solver is not None:
                self._solver.reset()
            self._shape, self._materials = shape, materials
        if self._membrane is not None:
            self._membrane.reset()
        imaging = self.scene.imaging
        gain = imaging.gain + draw.gain
        self.scanner.apply_settings(
            self.scanner.probe, dataclasses.replace(imaging, gain=gain), imaging.acoustics
        )
        self._number = 0
        self._wrench = np.zeros(6)

    def step(self, pose: Pose) -> ScanState:
        """Move the probe to a pose in frame ``patient``, and let tissue and skin follow.

        Raises:
            PoseError, ProbeError: the pose is nowhere near.
        """
        with self._blas.limit(limits=1, user_api="blas"):
            deformation: Deformation | None = None
            if self._solver is not None:
                deformation = self._solver.deform(pose)
                if deformation.is_balanced:
                    self._wrench = np.concatenate([deformation.force, deformation.torque])
            skin = self._membrane.deform(pose).vertices if self._membrane is not None else None
        nodes = deformation.nodes if deformation is not None else None
        time = self._number * self.scene.episode.period
        frame = self.scanner.make_frame(pose, nodes, skin=skin, number=self._number, time=time)
        self._number += 1
        is_balanced = deformation is None or deformation.is_balanced
        return ScanState(pose, frame, self._wrench, is_balanced, self._strains)

    def state(self) -> SimulationSnapshot:
        """Copy the states of tissue and skin, so that `restore` can go on from here."""
        moving = _copy_moving(self._solver), _copy_moving(self._membrane)
        return SimulationSnapshot(self._draw, *moving, self._wrench, self._number)

    def restore(self, state: SimulationSnapshot) -> None:
        """Go on from a state of this simulation, as often as needed."""
        if state.draw is not self._draw:
            self.reset(state.draw)
        self._solver, self._membrane = _copy_moving(state.solver), _copy_moving(state.membrane)
        self._wrench, self._number = state.wrench, state.number

    def compute_labels_at_rest(self, pose: Pose) -> NDArray[np.uint8]:
        """Return labels (rows, columns) in the plane of a pose, of tissue at rest."""
        nodes = self._solver.model.mesh.nodes if self._solver is not None else None
        return self.scanner.render_labels(lift_probe(pose), nodes)

    def _make_scanner(self, draw: EpisodeDraw) -> None:
        base, model, _ = self._load_drawn(draw.speckle)
        deeper = np.diag([1.0, 1.0, draw.thickness, 1.0])
        self.volume = dataclasses.replace(base, index_to_patient=deeper @ base.index_to_patient)
        self.scanner = build_scanner(self.scene, self.volume)
        if self._membrane is not None:
            surface = self._membrane.surface
            self.scanner.attach_skin(surface.vertices, surface.triangles)
        if model is not None:
            self._mesh = mesh = _scale_depths(model.mesh, draw.thickness)
            self.scanner.attach_mesh(mesh.nodes, mesh.tetrahedra)
            self._strains = AxialStrain(mesh.nodes, mesh.tetrahedra)

    def _make_tissue(self, draw: EpisodeDraw) -> None:
        scene, (_, model, fractions) = self.scene, self._load_drawn(draw.speckle)
        if model is None or scene.tissue is None:
            return
        materials = {
            name: dataclasses.replace(
                given,
                young_modulus=given.young_modulus * draw.stiffness.get(name, 1.0),
                lumen_pressure=given.lumen_pressure and given.lumen_pressure * draw.lumen_pressure,
            )
            for name, given in scene.tissue.materials.items()
        }
        constants = build_materials(scene, materials, self._mesh, self.volume, fractions)
        model = dataclasses.replace(model, mesh=self._mesh, materials=constants)
        method = SOLVERS.load(scene.tissue.solver)
        settings = scene.solver_settings(scene.tissue.solver) or method.Settings()
        if self._solver is None:
            show = late_progress("preparing the tissue")
            self._solver = compile_solver(method, model, settings, show)
        else:
            self._solver = method(model, settings)

    def _load_drawn(
        self, speckle: int | None
    ) -> tuple[Volume, TissueModel | None, LabelFractions | None]:
        """Load the volume of a seed, its tissue, and the labels in its mesh; keep the last."""
        if speckle not in self._volumes:
            given, scene = self.scene.volume, self.scene
            if speckle is not None:
                scene = dataclasses.replace(scene, volume=dataclasses.replace(given, seed=speckle))
            volume = load_volume(scene, late_progress("making the volume"))
            model = build_tissue_model(scene, volume) if scene.tissue else None
            fractions = compute_label_fractions(model.mesh, volume) if model else None
            is_live = scene.imaging.acoustics.is_live and volume.labels is not None
            self._normals[speckle] = find_surface_normals(volume) if is_live else None
            while len(self._volumes) >= _VOLUMES:
                oldest = next(iter(self._volumes))
                del self._volumes[oldest], self._normals[oldest]
            self._volumes[speckle] = volume, model, fractions
        return self._volumes[speckle]


T = TypeVar("T")


def _copy_moving(moving: T) -> T:
    """Copy an object, but share the frozen dataclasses in it, such as the model."""
    constants = [
        value
        for value in getattr(moving, "__dict__", {}).values()
        if dataclasses.is_dataclass(value) and value.__dataclass_params__.frozen  # type: ignore
    ]
    return copy.deepcopy(moving, {id(constant): constant for constant in constants})


def _scale_depths(mesh: TetrahedralMesh, factor: float) -> TetrahedralMesh:
    """Return the mesh with all depths multiplied."""
    if mesh.planes is not None:
        x, y, z = mesh.planes
        return box_mesh(x, y, np.asarray(z) * factor)
    return TetrahedralMesh(mesh.nodes * [1.0, 1.0, factor], mesh.tetrahedra)
