"""`us-sim evaluate slice`: how wrong each method's images are, against how long they take.

Every method cuts the same images of a block of speckle, in turns in one run; each is compared with
what it must show by brute force in float64 (`us_sim.evaluation.slice_reference`). VTK takes part
where it is installed.
"""

from __future__ import annotations

import csv
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.evaluation.slice_cases import MAIN, Case, Frame, cases, speckle
from us_sim.evaluation.slice_memory import peak_memory
from us_sim.evaluation.slice_points import COLUMNS, Contender, Point, compare, timed_together
from us_sim.evaluation.slice_reference import exact_slice
from us_sim.evaluation.slice_report import table, write_report
from us_sim.evaluation.slice_vtk import HOW_TO_GET, VtkSlicer, is_installed
from us_sim.progress import Progress
from us_sim.slicing.slicer import METHODS, create_slicer
from us_sim.volume.volume import Volume

__all__ = ["evaluate_slice"]

# Threads that each method is given.
_THREADS = {"scan_conversion": (1, 2), "row_subdivision": (1, 2), "per_pixel": (1,), "vtk": (1, 2)}
_LARGE_VOLUME = 512  # voxels a side, whose memory is asked for
_FRAMES = 4  # that a case's images go through
_SECONDS, _SECONDS_OF_MAIN = 4.0, 15.0  # of timing a case
_QUICK_SECONDS, _QUICK_SECONDS_OF_MAIN = 2.0, 6.0


def evaluate_slice(out: Path, quick: bool) -> int:
    """Measure, write slice.csv, the pictures and slice.md, and print the table.

    Args:
        out: folder to write to; made if it is not there.
        quick: fewer cases, timed more shortly.

    Returns:
        0, or 1 when a method failed; its row says how, and the others are there.

    Raises:
        UsSimError: the folder cannot be written.
    """
    begin = time.perf_counter()
    _prepare(out)
    volume = speckle()
    planned = cases(quick)
    points: list[Point] = []
    with Progress("slices", len(planned), "cases") as progress:
        for done, case in enumerate(planned):
            progress.update(done, case.name)
            points += _points(volume, case, quick)
        progress.update(len(planned))
    with (out / "slice.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(point.row for point in points)
    memory = peak_memory(_LARGE_VOLUME)
    seconds = time.perf_counter() - begin
    pictures = write_report(out, points, [], memory, quick, seconds)
    print(table(points))
    if not is_installed():
        print(HOW_TO_GET)
    print(f"Report: {out / 'slice.md'}; pictures: {', '.join(map(str, pictures))}")
    failed = [point for point in points if point.failure]
    for point in failed:
        print(f"failed: {point.method} on {point.size} px, {point.nodes} nodes: {point.failure}")
    return 1 if failed else 0


def _prepare(out: Path) -> None:
    """Make sure of the folder before the long run.

    Raises:
        UsSimError: it cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "slice.csv").open("a", encoding="utf-8").close()
    except OSError as error:
        raise UsSimError(
            f"--out {out}: cannot be written ({error.strerror or error}); name another folder"
        ) from error


def _points(volume: Volume, case: Case, quick: bool) -> list[Point]:
    """A row for every method."""
    mesh, frames = case.mesh(), case.frames(_FRAMES)
    frame = frames[0]
    exact = exact_slice(volume, mesh.nodes, mesh.tetrahedra, frame.nodes, frame.plane)
    contenders: list[Contender] = []
    errors = {}
    points = {}
    for method in (*METHODS, *(["vtk"] if is_installed() else [])):
        for threads in _THREADS[method]:
            key = (method, threads)
            points[key] = Point(
                method,
                case.size,
                len(mesh.nodes),
                len(mesh.tetrahedra),
                threads,
                deformation=case.deformation,
                plane=case.plane,
            )
            try:
                contender = _contender(volume, case, method, threads)
                image, rest = contender.image(frame), contender.rest_coordinates(frame)
            # Whatever breaks in one method must not take the others' results along.
            except Exception as error:
                words = f"{type(error).__name__}: {error}".replace("\n", " ")
                points[key] = replace(points[key], failure=words)
                continue
            errors[key] = compare(volume, frame, exact, image, rest, tissue_only=method == "vtk")
            contenders.append(contender)
    main = case == MAIN
    if quick:
        seconds = _QUICK_SECONDS_OF_MAIN if main else _QUICK_SECONDS
    else:
        seconds = _SECONDS_OF_MAIN if main else _SECONDS
    for contender, (timing, parts) in zip(
        contenders, timed_together(contenders, frames, seconds), strict=True
    ):
        key = (contender.method, contender.threads)
        points[key] = replace(
            points[key],
            **errors[key]._asdict(),
            ms_median=timing.median,
            ms_p99=timing.p99,
            filter_ms=parts[0],
            sampling_ms=parts[1],
            images=len(timing.milliseconds),
        )
    return list(points.values())


def _contender(volume: Volume, case: Case, method: str, threads: int) -> Contender:
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

    def image(frame: Frame) -> NDArray[np.uint8]:
        return slicer.image(frame.nodes, frame.plane)

    def rest(frame: Frame) -> NDArray[np.float64]:
        return slicer.rest_coordinates(frame.nodes, frame.plane)

    return Contender(method, threads, image, rest)
