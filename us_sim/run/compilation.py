"""Compiling all kernels ahead, so that no run waits for it.

A kernel is compiled where it is first called, and kept for all processes of the user, as
`us_sim.kernels` says. So every part is made small, and used once.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from us_sim.progress import Progress
from us_sim.settings.registry import SLICERS, SOLVERS

if TYPE_CHECKING:
    from us_sim.tissue.model import TissueModel

Part = tuple[str, Callable[[], object]]  # what a person reads, and what compiles it


def compile_kernels() -> int:
    """Compile every kernel of a simulation, or find it in the cache; with a bar."""
    work = list(parts())
    with Progress("compiling", len(work), "parts") as bar:
        for done, (name, compiled) in enumerate(work):
            bar.update(done, name)
            compiled()
        bar.update(len(work))
    return 0


def parts() -> Iterator[Part]:
    """Parts that a simulation may be made of, those that take longest first."""
    for solver in sorted(SOLVERS.importable, key=lambda name: name != "fem_nonlinear"):
        yield solver, partial(_use_solver, solver, box=True)
    for solver in SOLVERS.importable:
        yield f"{solver} on any mesh", partial(_use_solver, solver, box=False)
    yield "materials", _count_labels
    yield "skin", _use_skin
    for method in SLICERS:
        yield method, partial(_make_image, method)
    yield "strain", partial(_warm_up, "us_sim.slicing.strain_estimate")
    yield "blood", partial(_warm_up, "us_sim.slicing.flow.doppler")
    yield "camera", _track_marker
    yield "reconstruction", _reconstruct


def _block(*, box: bool) -> TissueModel:
    from dataclasses import replace

    from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
    from us_sim.tissue.model import TissueModel

    block = TissueModel.block(nodes=(4, 4, 4))
    mesh = block.mesh if box else TetrahedralMesh(block.mesh.nodes, block.mesh.tetrahedra)
    return replace(block, mesh=mesh)


def _use_solver(name: str, *, box: bool) -> None:
    from us_sim.tissue.solvers.solver import create_solver

    create_solver(name, _block(box=box)).warm_up()


def _warm_up(module: str) -> None:
    importlib.import_module(module).warm_up()


def _count_labels() -> None:
    from us_sim.tissue.elasticity.materials import label_fractions

    label_fractions(_block(box=True).mesh, np.zeros((4, 4, 4), dtype=np.uint8), np.eye(4))


def _use_skin() -> None:
    from us_sim.geometry.collider import Sphere
    from us_sim.skin.membrane import SkinMembrane
    from us_sim.skin.surface import plane_surface

    SkinMembrane(plane_surface((0.04, 0.04), 0.01), Sphere(0.03)).warm_up()


def _make_image(method: str) -> None:
    from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
    from us_sim.slicing.b_mode import BMode
    from us_sim.slicing.probe.probe import LinearProbe
    from us_sim.slicing.settings import Imaging
    from us_sim.volume.volume import Volume

    voxels = np.zeros((4, 4, 4), dtype=np.uint8)
    volume = Volume(voxels, np.diag([0.01, 0.01, 0.01, 1.0]), voxels, {0: "nothing"})
    probe = LinearProbe(aperture=0.02, depth=0.02, columns=16, rows=16)
    imaging = Imaging(
        gain=3.0,
        time_gain=(0.0, 3.0),
        elevation_planes=3,
        lateral_resolution=2e-3,
        axial_resolution=1e-3,
        contact=True,
    )
    BMode(volume, probe, method=method).prepare(probe, Imaging(gain=3.0))
    muscle = TissueAcoustics(attenuation=0.57, impedance=1.6e6, fibres=(0.0, 1.0, 0.0))
    sound = Acoustics(artefacts="live", noise=-90.0, tissues={"nothing": muscle})
    BMode(volume, probe, imaging, method=method).prepare(probe, imaging, sound)


def _track_marker() -> None:
    from us_sim.tracking.camera.rigid_body import RigidBody
    from us_sim.tracking.camera.source import practice

    practice(RigidBody.single("4X4_50", 7, 0.04))


def _reconstruct() -> None:
    from us_sim.volume.reconstruction.grid import grid_around
    from us_sim.volume.reconstruction.insertion import Insertion, fill_holes

    grid = grid_around(np.array([[0.0, 0.0, 0.0], [0.002, 0.002, 0.002]]), 0.001)
    pixels, place = np.ones(1, np.uint8), (np.zeros((1, 3)), np.eye(3, 4))
    for compounding in ("mean", "median"):
        inserted = Insertion(grid, method="nearest", compounding=compounding)
        if inserted.is_median:
            inserted.count(*place)
        inserted.insert(pixels, *place)
        fill_holes(*inserted.result(), 1.0)
