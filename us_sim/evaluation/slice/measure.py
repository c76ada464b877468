"""Every slicing method cuts the same images, in turns; each is compared with brute force.

>>> from us_sim.evaluation.slice.measure import SLICING_METHODS
>>> [name for name, method in SLICING_METHODS.items() if method.tissue_only]
['vtk']
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.report import Row, not_a_column, words_of
from us_sim.evaluation.slice.cases import (
    DEPTHS,
    MAIN,
    Case,
    ExactSlice,
    Frame,
    black_and_white,
    exact_slice,
    sampled,
    speckle,
    voxel_distance,
)
from us_sim.evaluation.timing import medians_in_turn
from us_sim.geometry.pose import Pose
from us_sim.slicing.cutting.slicer import Slicer, create_slicer
from us_sim.slicing.formation.coupling import ContactSurface
from us_sim.slicing.formation.image_formation import ImageFormation
from us_sim.slicing.probe.plane import SlicePlane
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.slicing.settings import Imaging
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]

OURS = "scan_conversion"
"""The method that the others are compared with, and that the targets are about."""

HOW_TO_GET = "VTK was left out, since it is not installed: pip install 'us_sim[evaluate]' adds it"


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
SLICING_METHODS = {method.name: method for method in _ALL}
"""By name, in the reports' order; colours are told apart in every common colour blindness."""


@dataclass(frozen=True)
class Point(Row):
    """A row of slice.csv, and its failure."""

    method: str
    size: int  # columns, and rows
    nodes: int
    tets: int
    threads: int
    ms_median: float = float("nan")
    ms_p99: float = float("nan")
    coverage_mismatch_px: int = 0  # pixels that show tissue, the rigid volume or black wrongly
    max_grey_difference: float = float("nan")
    mean_grey_difference: float = float("nan")
    max_voxel_error: float = float("nan")  # of places at rest, of pixels without a mismatch
    deformation: str = ""
    plane: str = ""
    cpu_ms_median: float = float("nan")  # processor time, of all threads
    filter_ms: float = float("nan")  # of VTK: finding pixels, processor time
    sampling_ms: float = float("nan")  # of VTK: sampling, processor time
    images: int = 0  # that were timed
    failure: str = not_a_column("")

    @property
    def title(self) -> str:
        return f"{self.method} on {self.size} px, {self.nodes} nodes"


def is_installed() -> bool:
    """Whether VTK can be imported."""
    return importlib.util.find_spec("vtkmodules") is not None


def methods() -> list[SlicingMethod]:
    """Methods that can be evaluated here."""
    return [method for name, method in SLICING_METHODS.items() if name != "vtk" or is_installed()]


def slicer_of(method: str, threads: int, volume: Volume, mesh: TetrahedralMesh) -> AnySlicer:
    """A method that is ready to cut a volume, carried by a mesh.

    Raises:
        ImportError: the method's module, or a library of it, cannot be imported.
    """
    if method == "vtk":
        return VtkSlicer(volume, mesh.nodes, mesh.tetrahedra, threads)
    return create_slicer(method, volume, mesh.nodes, mesh.tetrahedra, threads=threads)


class Bench:
    """Cuts cases with every method; keeps the volumes that they cut.

    Args:
        seconds: s, of timing the main case, and another.
    """

    def __init__(self, seconds: tuple[float, float]) -> None:
        self.volume, self._contrast = speckle(), black_and_white()
        self._seconds = seconds

    def points(self, case: Case) -> list[Point]:
        """A row for every method."""
        mesh, frames = case.mesh(), case.frames(4)
        first = frames[0]
        exact = exact_slice(self.volume, mesh.nodes, mesh.tetrahedra, first.nodes, first.plane)
        shown = sampled(self._contrast, exact.rest)
        seen: dict[str, NDArray[np.uint8]] = {}
        slicers: dict[tuple[str, int], AnySlicer] = {}
        points: dict[tuple[str, int], Point] = {}
        for method, threads in ((m, n) for m in methods() for n in m.threads):
            point = Point(
                *(method.name, case.size, len(mesh.nodes), len(mesh.tetrahedra), threads),
                deformation=case.deformation,
                plane=case.plane,
            )
            try:
                slicer = slicer_of(method.name, threads, self.volume, mesh)
                if method.name not in seen:
                    other = slicer_of(method.name, threads, self._contrast, mesh)
                    seen[method.name] = other.image(first.nodes, first.plane)
                errors: Any = compare(
                    *(self.volume, first, exact, slicer.image(first.nodes, first.plane)),
                    slicer.rest_coordinates(first.nodes, first.plane),
                    (shown, seen[method.name]),
                    tissue_only=method.tissue_only,
                )
            # Whatever breaks in one method must not take the others' results along.
            except Exception as error:
                points[method.name, threads] = replace(point, failure=words_of(error))
                continue
            points[method.name, threads] = replace(point, **errors)
            slicers[method.name, threads] = slicer
        times: Any = timed_together([*slicers.values()], frames, self._seconds[case != MAIN])
        for key, columns in zip(slicers, times, strict=True):
            points[key] = replace(points[key], **columns)
        return list(points.values())


def timed_together(
    slicers: Sequence[AnySlicer], frames: Sequence[Frame], seconds: float
) -> list[dict[str, float]]:
    """Times of all slicers, by columns of `Point`, in turns on a noisy machine.

    The probe moves on from image to image. A turn has five images of a method that takes less than
    8 ms, one of another.

    Args:
        slicers: to be timed; each has cut an image before, so that nothing is compiled now.
        frames: that they cut, over and over.
        seconds: after which no further turn begins, if each has had three; methods slower than 150
            ms sit those out.
    """
    found: list[list[float]] = [[] for _ in slicers]
    processor: list[list[float]] = [[] for _ in slicers]
    parts: list[list[tuple[float, float]]] = [[] for _ in slicers]
    begin = time.perf_counter()
    turn = 0
    while turn < 3 or time.perf_counter() - begin < seconds:
        for number, slicer in enumerate(slicers):
            if turn and min(found[number]) > 150.0 and time.perf_counter() - begin > seconds:
                continue
            for image in range(5):
                frame = frames[(turn + image) % len(frames)]
                before, worked = time.perf_counter(), time.process_time()
                slicer.image(frame.nodes, frame.plane)
                found[number].append((time.perf_counter() - before) * 1e3)
                processor[number].append((time.process_time() - worked) * 1e3)
                if isinstance(slicer, VtkSlicer):
                    parts[number].append((slicer.filter_ms, slicer.sampling_ms))
                if min(found[number]) > 8.0:
                    break
        turn += 1
    timings = []
    for wall, own, known in zip(found, processor, parts, strict=True):
        finding, sampling = np.median(known, axis=0).tolist() if known else (math.nan, math.nan)
        timings.append(
            {
                "ms_median": float(np.median(wall)),
                "ms_p99": float(np.percentile(wall, 99)),
                "cpu_ms_median": float(np.median(own)),
                "filter_ms": finding,
                "sampling_ms": sampling,
                "images": len(wall),
            }
        )
    return timings


def compare(
    volume: Volume,
    frame: Frame,
    exact: ExactSlice,
    image: NDArray[np.uint8],
    rest: Array,
    contrast: tuple[Array, NDArray[np.uint8]] | None = None,
    tissue_only: bool = False,
) -> dict[str, float]:
    """Errors, by columns of `Point`, of an image (rows, columns) and of its places at rest.

    Args:
        volume: that was cut.
        frame: nodes and plane.
        exact: the reference.
        image: grey values.
        rest: (rows, columns, 3) m, places at rest; NaN where the method found nothing.
        contrast: reference and image of a volume of black and white voxels: whatever the method
            says in ``rest``, there a pixel shows its place to half a grey level or 0.002 voxels.
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
        distance = max(distance, (off - 0.5 - 1e-6) / 255.0)
    return {
        "coverage_mismatch_px": int(wrong.sum()),
        "max_grey_difference": float(grey.max(initial=0.0)),
        "mean_grey_difference": float(grey.mean()) if grey.size else 0.0,
        "max_voxel_error": float(distance),
    }


def wrong_pixels(
    volume: Volume, frame: Frame, exact: ExactSlice, rest: Array, tissue_only: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], Array]:
    """Which pixels' coverage is right and which wrong; arguments as for `compare`.

    Returns:
        (rows, columns): where both show the same kind of thing and something; where they do not
        show the same; and (rows, columns, 3) m, where each pixel is from.
    """
    expected = np.where(exact.tissue[..., None], exact.rest, np.nan) if tissue_only else exact.rest
    known, seen = np.isfinite(expected[..., 0]), np.isfinite(rest[..., 0])
    pixels = frame.plane.pixels()
    moved = voxel_distance(volume, expected, pixels) > 0.01
    seen_moved = voxel_distance(volume, rest, pixels) > 0.005
    # Tissue that hardly moved is where the rigid volume is, and shows the same.
    right = known & seen & ~(moved & ~seen_moved) & (exact.tissue | ~seen_moved)
    return right, (known | seen) & ~right, expected


def costs(
    volume: Volume, quick: bool
) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """ms of processor time of whole images in the main case, by probe and by imaging setting.

    The third are the parts of each probe's pixels that show something.
    """
    mesh, frames = MAIN.mesh(), MAIN.frames(4)
    linear = LinearProbe(aperture=0.06, depth=0.08, columns=MAIN.size, rows=MAIN.size)
    size: Any = {"depth": 0.08, "columns": MAIN.size, "rows": MAIN.size}
    probes: dict[str, Probe] = {
        "linear, 60 × 80 mm": linear,
        "convex, 40 mm radius, 60°": ConvexProbe(
            radius=0.04, opening_angle=math.radians(60), **size
        ),
        "sector, 90°": SectorProbe(aperture=0.02, opening_angle=math.radians(90), **size),
    }
    settings = {
        "all at their defaults": Imaging(),
        "gain": Imaging(gain=6.0),
        "time gain, dynamic range, grey map": Imaging(
            time_gain=(0.0, 3.0, 6.0), dynamic_range=50.0, grey_map="soft"
        ),
        "lateral and axial resolution": Imaging(lateral_resolution=1.5e-3, axial_resolution=0.5e-3),
        "contact": Imaging(contact=True),
        "5 elevation planes": Imaging(elevation_planes=5),
    }
    slicer = create_slicer(OURS, volume, mesh.nodes, mesh.tetrahedra)
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

    work = {name: imaged(probe, Imaging()) for name, probe in probes.items()}
    work |= {name: imaged(linear, imaging) for name, imaging in settings.items()}
    median = medians_in_turn(work, 16 if quick else 61, 1, all_threads=True)
    shown = {name: float(probe.plane(pose).is_shown().mean()) for name, probe in probes.items()}
    return {n: median[n] for n in probes}, {n: median[n] for n in settings}, shown


class VtkSlicer:
    """Cuts images with VTK, as a user of VTK would, to compare with.

    `vtkProbeFilter` finds the pixels in the deformed mesh, whose nodes carry their coordinates at
    rest, and interpolates those; a second one samples the volume there. The mesh is passed to it in
    columns, rows and heights over the image, since it ignores an image's direction matrix; that is
    also its fast method, which goes through the cells instead of searching one for each pixel.

    Args:
        volume: in frame ``patient``.
        rest_nodes: (N, 3) m.
        tetrahedra: (M, 4) indices into the nodes.
        threads: more than the one that VTK's wheels use unless told otherwise.

    Raises:
        ImportError: VTK is not installed.
    """

    filter_ms = sampling_ms = float("nan")
    """Processor time of finding the latest image's pixels, and of sampling the volume there."""

    def __init__(
        self, volume: Volume, rest_nodes: Array, tetrahedra: NDArray[np.int32], threads: int = 1
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

    def image(self, nodes: Array, plane: SlicePlane) -> NDArray[np.uint8]:
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

    def rest_coordinates(self, nodes: Array, plane: SlicePlane) -> Array:
        """(rows, columns, 3) m, where each pixel's tissue lies at rest; NaN elsewhere."""
        self._find(nodes, plane)
        index = self._to_numpy(self._finder.GetOutput().GetPointData().GetArray("rest"))
        to_patient = np.linalg.inv(self._to_index)
        rest = index[:, ::-1] @ to_patient[:3, :3].T + to_patient[:3, 3]
        rest = rest.reshape(plane.rows, plane.columns, 3)
        rest[~self._valid(plane)] = np.nan
        return np.asarray(rest)

    def _find(self, nodes: Array, plane: SlicePlane) -> None:
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


AnySlicer = Slicer | VtkSlicer
