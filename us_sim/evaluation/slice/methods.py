"""What the evaluation knows of each slicing method: all of it stands here, one entry a method.

>>> from us_sim.evaluation.slice.methods import SLICING_METHODS
>>> [name for name, method in SLICING_METHODS.items() if method.tissue_only]
['vtk']
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.named import Named
from us_sim.evaluation.slice.cases import Case, Frame
from us_sim.evaluation.slice.vtk_images import VtkSlicer, is_installed
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.volume.volume import Volume

OURS = "scan_conversion"
"""The method that the others are compared with, and that the targets are about."""


@dataclass(frozen=True)
class SlicingMethod:
    """One slicer of the package, or VTK's."""

    name: str
    colour: str
    mark: str  # of its points in a plot, as Matplotlib names it
    threads: tuple[int, ...]  # numbers of threads that it is timed with
    tissue_only: bool = False  # it knows nothing of the rigid volume around the tissue, as VTK


_ALL = (
    SlicingMethod(OURS, "#D55E00", "D", (1, 2)),
    SlicingMethod("row_subdivision", "#0072B2", "o", (1, 2)),
    SlicingMethod("per_pixel", "#009E73", "s", (1,)),
    SlicingMethod("vtk", "#CC79A7", "^", (1, 2), tissue_only=True),
)
SLICING_METHODS = Named("evaluated slicing method", {method.name: method for method in _ALL})
"""By name, in the reports' order; colours are told apart in every common colour blindness."""


@dataclass(frozen=True)
class Contender:
    """A method ready to cut a case's images."""

    method: str
    threads: int
    image: Callable[[Frame], NDArray[np.uint8]]
    rest_coordinates: Callable[[Frame], NDArray[np.float64]]
    parts: Callable[[], tuple[float, float]] | None = None  # ms of the latest image, where known


def methods() -> list[SlicingMethod]:
    """Those that can be evaluated here."""
    return [method for name, method in SLICING_METHODS.items() if name != "vtk" or is_installed()]


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
