"""Rows of image.csv, the arm at five tilts, and the run time of its images.

>>> from us_sim.evaluation.image.measure import make_row
>>> round(make_row("attenuation", "linear", 20.0, 0.01, -6.0, -6.1, "dB")["error_percent"], 2)
-1.14
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from us_sim.geometry.pose import Pose
from us_sim.scene.building import build_probe, load_volume
from us_sim.scene.reading import load_scene
from us_sim.slicing.acoustics.settings import Acoustics
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.settings import Imaging
from us_sim.slicing.strain import AxialStrain
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes


def make_row(
    artefact: str,
    probe: str,
    tilt: float,
    depth: float,
    expected: float,
    measured: float,
    unit: str,
) -> dict[str, Any]:
    """Make the row of a number expected and one measured in the image.

    The error of dB is that of the amplitude, in percent; that of other units is 100 times the
    difference. The tilt is in degrees, the depth in m.
    """
    if unit == "dB":
        error = 100.0 * (10.0 ** ((measured - expected) / 20.0) - 1.0)
    else:
        error = 100.0 * (measured - expected)
    return {
        "artefact": artefact,
        "probe": probe,
        "tilt_deg": tilt,
        "depth_mm": 1e3 * depth,
        "expected": expected,
        "measured": measured,
        "unit": unit,
        "error_percent": error,
    }


def make_tilted_pose(degrees: float, *, elevational: bool = False) -> Pose:
    """Make the pose of a probe at the origin, turned about y in its image plane, or about x."""
    turn = Rotation.from_euler("x" if elevational else "y", degrees, degrees=True)
    return Pose(np.zeros(3), turn.as_quat())


def make_arm_images() -> dict[str, dict[str, NDArray[np.uint8]]]:
    """Make images by the acoustics, and by the tilt of a probe that turns about the bone."""
    scene = load_scene("upper_arm")
    volume, side = load_volume(scene), 320
    deep: Any = build_probe(scene)
    probe = dataclasses.replace(deep, depth=0.054).with_pixels(side, round(1.35 * side))
    full = scene.imaging.acoustics
    bone, from_bone = np.array([12e-3, 0.0, 38e-3]), np.array([-6e-3, 0.0, -36e-3])  # m
    turns = {
        f"{degrees:g}°": make_tilted_pose(degrees) for degrees in (-20.0, -10.0, 0.0, 10.0, 20.0)
    }
    found = {}
    for name, acoustics in (
        ("all artefacts", full),
        ("loss, shadows, fibres", dataclasses.replace(full, surfaces=False, noise=None)),
        ("the slice alone", None),
    ):
        scanner = BMode(volume, probe, Imaging(), acoustics)
        found[name] = {
            tilt: scanner.render_image(Pose(bone + turned.rotation @ from_bone, turned.orientation))
            for tilt, turned in turns.items()
        }
    return found


def measure_run_times(quick: bool) -> Iterator[dict[str, Any]]:
    """Time images of 512 × 512 of the pressed arm, in turn, with the same disturbances."""
    scene = load_scene("upper_arm")
    volume, probe = load_volume(scene), build_probe(scene).with_pixels(512, 512)
    full = scene.imaging.acoustics
    none = dataclasses.replace(full, surfaces=False, anisotropy=False, noise=None)
    kinds: dict[str, Acoustics | None] = {
        "slice": None,
        "strain": None,
        "loss": none,
        "loss_and_surfaces": dataclasses.replace(none, surfaces=True),
        "loss_and_fibres": dataclasses.replace(none, anisotropy=True),
        "all": full,
    }
    sides = zip(((-0.036, 0.036), (-0.03, 0.03), (0.0, 0.054)), (32, 16, 16), strict=True)
    mesh, press = box_mesh(*(uniform_planes(*side, n) for side, n in sides)), 8e-3  # m
    x, y, z = mesh.nodes.T
    nodes = mesh.nodes.copy()
    nodes[:, 2] += press * np.exp(-(x**2 + y**2) / 0.02**2) * (1.0 - z / 0.054)
    strain = AxialStrain(mesh.nodes, mesh.tetrahedra)

    def make_imager(acoustics: Acoustics | None, with_strain: bool) -> Callable[[Pose], object]:
        scanner = BMode(volume, probe, Imaging(), acoustics)
        scanner.attach_mesh(mesh.nodes, mesh.tetrahedra)

        def make_image(pose: Pose) -> None:
            frame = scanner.make_frame(pose, nodes)
            _ = frame.pixels
            if with_strain:
                strain.compute_strain(frame)

        return make_image

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        medians = _time_in_turn(
            {name: make_imager(acoustics, name == "strain") for name, acoustics in kinds.items()},
            [Pose(np.array([2e-4 * (k % 7), 0.0, press])) for k in range(60 if quick else 300)],
            uncounted=5,
        )
    finally:
        cv2.setNumThreads(threads)
    for name, ms in medians.items():
        yield make_row(f"run_time_{name}", "linear", np.nan, np.nan, np.nan, ms, "ms")


def _time_in_turn(
    functions: Mapping[str, Callable[[Pose], object]], poses: Sequence[Pose], uncounted: int
) -> dict[str, float]:
    """Return the median processor time (ms) of each function, called in turn on a noisy machine.

    Each is called with every pose; the first ``uncounted`` calls may compile, and do not count.
    """
    found: dict[str, list[float]] = {name: [] for name in functions}
    for pose in poses:
        for name, function in functions.items():
            began = time.thread_time()
            function(pose)
            found[name].append(1e3 * (time.thread_time() - began))
    return {name: float(np.median(ms[uncounted:])) for name, ms in found.items()}
