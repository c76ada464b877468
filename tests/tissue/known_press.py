"""Presses of tissues whose moduli are known: a block of two layers, and the arm of a scene."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from wrench_files import write_wrenches

from us_sim.geometry.collider import Sphere
from us_sim.recording.path import ProbePath, write_poses
from us_sim.recording.press_and_slide import press_and_slide
from us_sim.recording.wrench import WrenchRecord
from us_sim.recording.writer import BagWriter
from us_sim.scene.building import materials_of, tissue_model_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import LabelFractions, average_over_labels
from us_sim.tissue.identification.press_model import PressModel
from us_sim.tissue.identification.press_record import PressRecord, paired
from us_sim.tissue.identification.stiffness import Tissue
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.tissue.model import TissueModel, face_nodes

LAYERS = ("fat", "muscle")
TRUE = {"fat": 6e3, "muscle": 18e3}  # Pa
TARE = np.array([0.3, -0.2, 0.5, 0.01, 0.0, 0.02])  # N and N m, which the sensor adds


def layered_block(nodes: tuple[int, int, int] = (6, 6, 6)) -> Tissue:
    """Fat over muscle, the border aslant; held at the bottom; a fit begins with 10 kPa."""
    mesh = box_mesh(
        uniform_planes(-0.04, 0.04, nodes[0]),
        uniform_planes(-0.04, 0.04, nodes[1]),
        uniform_planes(0.0, 0.05, nodes[2]),
    )
    corners = mesh.nodes[mesh.tetrahedra]
    weights = np.random.default_rng(0).dirichlet(np.ones(4), 200)
    samples = np.einsum("sa,tax->tsx", weights, corners)
    muscle = (samples[..., 2] > 0.02 + 0.3 * samples[..., 0]).mean(axis=1)
    fractions = LabelFractions(
        np.arange(2, dtype=np.uint8), np.column_stack([1.0 - muscle, muscle])
    )

    def materials_for(moduli: Mapping[str, float]):
        materials = {k: Material(moduli[name], 0.45) for k, name in enumerate(LAYERS)}
        return average_over_labels(fractions, materials)

    fixed = np.zeros(len(mesh.nodes), dtype=bool)
    fixed[face_nodes(mesh, "bottom")] = True
    start = dict.fromkeys(LAYERS, 10e3)
    model = TissueModel(mesh, materials_for(start), fixed, Sphere(0.03), face_nodes(mesh, "top"))
    return Tissue(model, materials_for, start)


def arm(scene: str | Path, nodes: tuple[int, int, int] | None = None) -> Tissue:
    """The tissue of a scene, on its own mesh or on one of so many nodes along x, y and z."""
    loaded = load_scene(str(scene))
    assert loaded.tissue is not None
    if nodes is not None:
        mesh = replace(loaded.tissue.mesh, nodes=nodes, planes={})
        loaded = replace(loaded, tissue=replace(loaded.tissue, mesh=mesh))
    volume = volume_of(loaded)
    model = tissue_model_of(loaded, volume)
    assert loaded.tissue is not None
    given = loaded.tissue.materials

    def materials_for(moduli: Mapping[str, float]):
        made = {name: replace(given[name], young_modulus=e) for name, e in moduli.items()}
        return materials_of(loaded, made, model.mesh, volume)

    return Tissue(model, materials_for, {name: m.young_modulus for name, m in given.items()})


def slide() -> ProbePath:
    """Six seconds in which the probe comes down, slides along and lifts, 20 poses a second."""
    time = np.linspace(0.0, 6.0, 121)
    depth = 0.012 * np.sin(np.pi * time / 6) ** 2 - 0.003
    positions = np.column_stack([0.02 * np.sin(time), 0.003 + 0 * time, depth])
    stamps = np.round(1e9 * time).astype(np.int64)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    return ProbePath("/probe/pose", "patient", stamps, positions, upright)


@dataclass(frozen=True, eq=False)
class KnownPress:
    """Where the probe goes, and what it feels of moduli (Pa) that are known."""

    tissue: Tissue
    moduli: Mapping[str, float]
    path: ProbePath

    @cached_property
    def felt(self) -> NDArray[np.float64]:
        """(K, 6) N and N m, without noise."""
        model = PressModel(self.tissue.model, self.tissue.materials_for, [], self.path.poses)
        return model.predict(self.moduli).wrenches

    def noisy(
        self, noise: float, random: np.random.Generator, correlation: float = 0.0
    ) -> NDArray[np.float64]:
        """(K, 6), with an offset and with noise of a fraction of the largest force and torque, of
        which neighbours correlate.
        """
        sizes = [np.linalg.norm(self.felt[:, k : k + 3], axis=1).max() for k in (0, 3)]
        errors = random.normal(size=self.felt.shape)
        for k in range(1, len(errors)):
            errors[k] = correlation * errors[k - 1] + np.sqrt(1 - correlation**2) * errors[k]
        return self.felt + noise * errors * np.repeat(sizes, 3) + TARE

    def record(self, wrenches: NDArray[np.float64]) -> PressRecord:
        """The press with these wrenches."""
        poses = self.path.stamps, self.path.positions, self.path.orientations
        return paired(poses, (self.path.stamps, wrenches), tolerance=0.01)


def block_press(tissue: Tissue | None = None) -> KnownPress:
    """Of the block of two layers."""
    return KnownPress(tissue or layered_block(), TRUE, slide())


def arm_press(scene: str | Path, rate: float = 20.0) -> KnownPress:
    """Of a scene's arm, by the demo's path, so many poses a second."""
    tissue = arm(scene)
    path = press_and_slide(rate=rate)
    return KnownPress(tissue, tissue.moduli, replace(path, topic="/probe/pose"))


def main() -> None:
    """``python tests/tissue/known_press.py SCENE FILE.mcap``: a press with 1 percent of noise."""
    scene, file = sys.argv[1:]
    press = arm_press(scene, rate=60.0)
    wrenches = press.noisy(0.01, np.random.default_rng(0))
    with BagWriter(file, compression="zstd") as writer:
        write_poses(writer, press.path)
        write_wrenches(writer, WrenchRecord("/probe/wrench", "probe", press.path.stamps, wrenches))


if __name__ == "__main__":
    main()
