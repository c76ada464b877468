"""The methods that `us-sim evaluate slice` compares: those of the package, and VTK's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.slice.cases import Case, Frame
from us_sim.evaluation.slice.vtk_images import VtkSlicer, is_installed
from us_sim.settings.registry import SLICERS
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.volume.volume import Volume

__all__ = ["Contender", "contender", "methods"]


@dataclass(frozen=True)
class Contender:
    """A method ready to cut a case's images."""

    method: str
    threads: int
    image: Callable[[Frame], NDArray[np.uint8]]
    rest_coordinates: Callable[[Frame], NDArray[np.float64]]
    parts: Callable[[], tuple[float, float]] | None = None  # ms of the latest image, where known


def methods() -> list[str]:
    """Every method there is, VTK where it is installed."""
    return [*SLICERS, *(["vtk"] if is_installed() else [])]


def contender(volume: Volume, case: Case, method: str, threads: int) -> Contender:
    """A method that is about to cut a case's images of a volume.

    Raises:
        ImportError: the method's module, or what it needs, cannot be imported.
    """
    mesh = case.mesh()
    if method == "vtk":
        vtk = VtkSlicer(volume, mesh.nodes, mesh.tetrahedra, threads)
        return Contender(
            method,
            threads,
            lambda frame: vtk.image(frame.nodes, frame.plane),
            lambda frame: vtk.rest_coordinates(frame.nodes, frame.plane),
            lambda: (vtk.filter_ms, vtk.sampling_ms),
        )
    slicer = create_slicer(method, volume, mesh.nodes, mesh.tetrahedra, threads=threads)
    return Contender(
        method,
        threads,
        lambda frame: slicer.image(frame.nodes, frame.plane),
        lambda frame: slicer.rest_coordinates(frame.nodes, frame.plane),
    )
