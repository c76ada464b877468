"""."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.named import Named
from us_sim.evaluation.report import (
    Row,
    not_a_column,
)
from us_sim.evaluation.slice.cases import (
    DEPTHS,
    MAIN,
    Case,
    ExactSlice,
    Frame,
    voxel_distance,
)
from us_sim.evaluation.timing import RunTimes
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.slicer import create_slicer
from us_sim.slicing.formation.coupling import ContactSurface
from us_sim.slicing.formation.image_formation import ImageFormation
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.slicing.settings import Imaging
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


HOW_TO_GET = "VTK was left out, since it is not installed: pip install 'us_sim[evaluate]' adds it"


def is_installed() -> bool:
    """Whether VTK can be imported."""
    return importlib.util.find_spec("vtkmodules") is not None


class VtkSlicer:
    """Cuts images with VTK.

    Args:
        volume: in frame ``patient``.
        rest_nodes: (N, 3) m.
        tetrahedra: (M, 4) indices into the nodes.
        threads: more than the one that VTK's wheels use unless told otherwise.

    Raises:
        ImportError: VTK is not installed.
    """

    filter_ms: float = float("nan")
    """Processor time of finding the pixels of the latest image."""
    sampling_ms: float = float("nan")
    """Processor time of sampling the volume for the latest image."""

    def __init__(
        self,
        volume: Volume,
        rest_nodes: NDArray[np.float64],
        tetrahedra: NDArray[np.int32],
        threads: int = 1,
    ) -> None:
        from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
        from vtkmodules.vtkCommonCore import VTK_ID_TYPE, vtkPoints, vtkSMPTools
        from vtkmodules.vtkCommonDataModel import (
            VTK_TETRA,
            vtkCellArray,
            vtkImageData,
            vtkPolyData,
            vtkUnstructuredGrid,
        )
        from vtkmodules.vtkFiltersCore import vtkProbeFilter

        self._workers, self._to_numpy = vtkSMPTools, vtk_to_numpy
        self._threads = threads
        self._to_index = volume.patient_to_index
        self._placed = np.empty(rest_nodes.shape)
        self._points = vtkPoints()
        self._points.SetData(numpy_to_vtk(self._placed))
        cells = vtkCellArray()
        starts = np.arange(0, 4 * len(tetrahedra) + 1, 4)
        numbers = (starts.astype(np.int64), tetrahedra.reshape(-1).astype(np.int64))
        cells.SetData(*(numpy_to_vtk(ids, deep=True, array_type=VTK_ID_TYPE) for ids in numbers))
        self._mesh = vtkUnstructuredGrid()
        self._mesh.SetPoints(self._points)
        self._mesh.SetCells(VTK_TETRA, cells)
        # VTK's first index runs fastest, so its x is the volume's last axis.
        index = rest_nodes @ self._to_index[:3, :3].T + self._to_index[:3, 3]
        at_rest = numpy_to_vtk(np.ascontiguousarray(index[:, ::-1]), deep=True)
        at_rest.SetName("rest")
        self._mesh.GetPointData().AddArray(at_rest)
        self._pixels = vtkImageData()
        self._finder = vtkProbeFilter()
        self._finder.SetInputData(self._pixels)
        self._finder.SetSourceData(self._mesh)

        self._voxels = vtkImageData()
        self._voxels.SetDimensions(*volume.shape[::-1])
        self._grey = volume.intensities.reshape(-1)  # VTK does not keep it
        grey = numpy_to_vtk(self._grey)
        grey.SetName("grey")
        self._voxels.GetPointData().SetScalars(grey)
        self._places = vtkPolyData()
        self._at = vtkPoints()
        self._places.SetPoints(self._at)
        self._sampler = vtkProbeFilter()
        self._sampler.SetInputData(self._places)
        self._sampler.SetSourceData(self._voxels)

    def image(self, nodes: NDArray[np.float64], plane: SlicePlane) -> NDArray[np.uint8]:
        """(rows, columns): the grey values of tissue, 0 elsewhere."""
        begin = time.process_time()
        self._find(nodes, plane)
        found = time.process_time()
        self._at.SetData(self._finder.GetOutput().GetPointData().GetArray("rest"))
        self._at.Modified()
        self._sampler.Update()
        grey = self._sampler.GetOutput().GetPointData().GetArray("grey")
        image = self._to_numpy(grey).reshape(plane.rows, plane.columns)
        image = np.where(self._valid(plane), image, np.uint8(0))
        self.filter_ms = (found - begin) * 1e3
        self.sampling_ms = (time.process_time() - found) * 1e3
        return image

    def rest_coordinates(
        self, nodes: NDArray[np.float64], plane: SlicePlane
    ) -> NDArray[np.float64]:
        """(rows, columns, 3) m, where each pixel's tissue lies at rest; NaN elsewhere."""
        self._find(nodes, plane)
        index = self._to_numpy(self._finder.GetOutput().GetPointData().GetArray("rest"))
        to_patient = np.linalg.inv(self._to_index)
        rest = index[:, ::-1] @ to_patient[:3, :3].T + to_patient[:3, 3]
        rest = rest.reshape(plane.rows, plane.columns, 3)
        rest[~self._valid(plane)] = np.nan
        return np.asarray(rest)

    def _find(self, nodes: NDArray[np.float64], plane: SlicePlane) -> None:
        # Threads are set for the whole process.
        self._workers.SetBackend("Sequential" if self._threads == 1 else "STDThread")
        self._workers.Initialize(self._threads)
        np.add(nodes @ plane.to_pixel[:, :3].T, plane.to_pixel[:, 3], out=self._placed)
        self._points.GetData().Modified()
        self._points.Modified()
        self._mesh.Modified()
        self._pixels.SetDimensions(plane.columns, plane.rows, 1)
        self._pixels.Modified()
        self._finder.Update()

    def _valid(self, plane: SlicePlane) -> NDArray[np.bool_]:
        """(rows, columns): which pixels of the latest image lie in the mesh."""
        mask = self._finder.GetOutput().GetPointData().GetArray("vtkValidPointMask")
        return np.asarray(self._to_numpy(mask).reshape(plane.rows, plane.columns) > 0)


_AGAIN = 5  # images in a turn of a method that takes less than _SHORT


_SHORT = 8.0  # ms


_FEWEST = 3  # turns of each method that takes less than _SLOW


_SLOW = 150.0  # ms


_MOVED = 0.01
"""Voxels by which tissue must have moved before taking it for the rigid volume can be told."""


_ROUNDED = 0.5 + 1e-6  # grey levels


class Errors(NamedTuple):
    """How much an image differs from what it must show."""

    coverage_mismatch_px: int  # pixels that show tissue, the rigid volume or black wrongly
    max_grey_difference: float
    mean_grey_difference: float
    max_voxel_error: float  # of the place at rest, over the pixels without a mismatch


@dataclass(frozen=True)
class Point(Row):
    """A row of slice.csv, and what the report says beyond it."""

    method: str
    size: int  # columns, and rows
    nodes: int
    tets: int
    threads: int
    ms_median: float = float("nan")
    ms_p99: float = float("nan")
    coverage_mismatch_px: int = 0
    max_grey_difference: float = float("nan")
    mean_grey_difference: float = float("nan")
    max_voxel_error: float = float("nan")
    deformation: str = ""
    plane: str = ""
    cpu_ms_median: float = float("nan")  # processor time, of all threads
    filter_ms: float = float("nan")  # of VTK: finding pixels, processor time
    sampling_ms: float = float("nan")  # of VTK: sampling, processor time
    images: int = 0  # that were timed
    failure: str = not_a_column("")

    @property
    def title(self) -> str:
        """The method and what it cut."""
        return f"{self.method} on {self.size} px, {self.nodes} nodes"


@dataclass(frozen=True, eq=False)
class Timing(RunTimes):
    """How long one method's images took."""

    processor: NDArray[np.float64]  # ms, of all threads
    parts: tuple[float, float] = (float("nan"), float("nan"))  # ms, medians, where they are known


def timed_together(
    contenders: Sequence[Contender], frames: Sequence[Frame], seconds: float
) -> list[Timing]:
    """Times of all contenders, taken in turns, so that a noisy machine is as noisy for all.

    The probe moves on from image to image. Where a method says what parts its images took, their
    medians come too.

    Args:
        contenders: to be timed; each has cut an image before, so that nothing is compiled now.
        frames: what they cut, over and over.
        seconds: after which no further turn begins, if each has had a few; slow methods sit those
            few out.
    """
    found: list[list[float]] = [[] for _ in contenders]
    processor: list[list[float]] = [[] for _ in contenders]
    parts: list[list[tuple[float, float]]] = [[] for _ in contenders]
    begin = time.perf_counter()
    turn = 0
    while turn < _FEWEST or time.perf_counter() - begin < seconds:
        for number, contender in enumerate(contenders):
            if turn and min(found[number]) > _SLOW and time.perf_counter() - begin > seconds:
                continue
            for image in range(_AGAIN):
                frame = frames[(turn + image) % len(frames)]
                before, worked = time.perf_counter(), time.process_time()
                contender.image(frame)
                found[number].append((time.perf_counter() - before) * 1e3)
                processor[number].append((time.process_time() - worked) * 1e3)
                if contender.parts is not None:
                    parts[number].append(contender.parts())
                if min(found[number]) > _SHORT:
                    break
        turn += 1
    timings = []
    for wall, own, known in zip(found, processor, parts, strict=True):
        timing = Timing(np.array(wall), np.array(own))
        medians = tuple(np.median(known, axis=0).tolist()) if known else timing.parts
        timings.append(replace(timing, parts=medians))
    return timings


def compare(
    volume: Volume,
    frame: Frame,
    exact: ExactSlice,
    image: NDArray[np.uint8],
    rest: NDArray[np.float64],
    contrast: tuple[NDArray[np.float64], NDArray[np.uint8]] | None = None,
    tissue_only: bool = False,
) -> Errors:
    """How wrong an image (rows, columns), and where it took it from (rows, columns, 3) m, are.

    Args:
        volume: that was cut.
        frame: what was cut.
        exact: what it must show.
        image: grey values.
        rest: NaN where the method found nothing.
        contrast: what the image of a volume of black and white voxels must show, and the method's
            image of it: whatever the method says in ``rest``, there a pixel shows where it comes
            from, to half a grey level or 0.002 voxels.
        tissue_only: the method knows nothing of the rigid volume outside the mesh: grey values
            and places are compared where both find tissue.
    """
    right, wrong, expected = wrong_pixels(volume, frame, exact, rest, tissue_only)
    greys = right if tissue_only else np.ones(right.shape, dtype=np.bool_)
    grey = np.abs(image - np.rint(exact.grey))[greys]
    distance = voxel_distance(volume, rest, expected)[right].max(initial=0.0)
    if contrast is not None:
        shown, seen = contrast
        off = np.abs(seen - shown)[right].max(initial=0.0)
        # A value is rounded to a whole one, and from black to white is a voxel.
        distance = max(distance, (off - _ROUNDED) / 255.0)
    return Errors(
        int(wrong.sum()),
        float(grey.max(initial=0.0)),
        float(grey.mean()) if grey.size else 0.0,
        float(distance),
    )


def wrong_pixels(
    volume: Volume, frame: Frame, exact: ExactSlice, rest: NDArray[np.float64], tissue_only: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
    """Which pixels' coverage is right and which wrong; arguments as for `compare`.

    Returns:
        (rows, columns): where both show the same kind of thing and something; where they do not
        show the same; and (rows, columns, 3) m, where each pixel is from.
    """
    expected = np.where(exact.tissue[..., None], exact.rest, np.nan) if tissue_only else exact.rest
    known, seen = np.isfinite(expected[..., 0]), np.isfinite(rest[..., 0])
    pixels = frame.plane.pixels()
    moved = voxel_distance(volume, expected, pixels) > _MOVED
    seen_moved = voxel_distance(volume, rest, pixels) > _MOVED / 2
    # Tissue that hardly moved is where the rigid volume is, and shows the same.
    right = known & seen & ~(moved & ~seen_moved) & (exact.tissue | ~seen_moved)
    return right, (known | seen) & ~right, expected


_LINEAR = LinearProbe(aperture=0.06, depth=0.08, columns=MAIN.size, rows=MAIN.size)


_PROBES: Mapping[str, Probe] = {
    "linear, 60 × 80 mm": _LINEAR,
    "convex, 40 mm radius, 60°": ConvexProbe(
        radius=0.04, opening_angle=math.radians(60), depth=0.08, columns=MAIN.size, rows=MAIN.size
    ),
    "sector, 90°": SectorProbe(
        aperture=0.02, opening_angle=math.radians(90), depth=0.08, columns=MAIN.size, rows=MAIN.size
    ),
}


_SETTINGS = {
    "all at their defaults": Imaging(),
    "gain": Imaging(gain=6.0),
    "time gain, dynamic range, grey map": Imaging(
        time_gain=(0.0, 3.0, 6.0), dynamic_range=50.0, grey_map="soft"
    ),
    "lateral and axial resolution": Imaging(lateral_resolution=1.5e-3, axial_resolution=0.5e-3),
    "contact": Imaging(contact=True),
    "5 elevation planes": Imaging(elevation_planes=5),
}


@dataclass(frozen=True)
class Cost:
    """One line of the table."""

    what: str
    ms: float  # of a whole image, processor time, median
    shown: float = 1.0  # part of the image's pixels that show something


def costs(volume: Volume, quick: bool) -> tuple[list[Cost], list[Cost]]:
    """Whole images in the main case on one thread: by probe, and by setting."""
    mesh = MAIN.mesh()
    frames = MAIN.frames(4)
    slicer = create_slicer("scan_conversion", volume, mesh.nodes, mesh.tetrahedra)
    surface = ContactSurface(mesh.nodes, mesh.boundary)
    pose = Pose(np.array([0.0, 0.0, DEPTHS[MAIN.deformation]]))

    def imaged(probe: Probe, imaging: Imaging) -> Callable[[int], object]:
        formation = ImageFormation(probe, imaging)

        def image(number: int) -> object:
            nodes = frames[number % len(frames)].nodes
            images = [slicer.image(nodes, plane) for plane in formation.planes(pose)]
            if not formation.needs_contact:
                return formation.form(images)
            return formation.form(images, *surface.contact(nodes, probe, pose))

        return image

    work = {name: imaged(probe, Imaging()) for name, probe in _PROBES.items()}
    work |= {name: imaged(_LINEAR, imaging) for name, imaging in _SETTINGS.items()}
    median = _medians(work, 15 if quick else 60)
    shown = {name: float(probe.plane(pose).is_shown().mean()) for name, probe in _PROBES.items()}
    probes = [Cost(name, median[name], shown[name]) for name in _PROBES]
    return probes, [Cost(name, median[name]) for name in _SETTINGS]


def _medians(work: Mapping[str, Callable[[int], object]], images: int) -> dict[str, float]:
    """ms of processor time each takes, all in turns; the first image of each is not counted."""
    found: dict[str, list[float]] = {name: [] for name in work}
    for number in range(images + 1):
        for name, image in work.items():
            before = time.process_time()
            image(number)
            found[name].append((time.process_time() - before) * 1e3)
    return {name: float(np.median(ms[1:])) for name, ms in found.items()}
