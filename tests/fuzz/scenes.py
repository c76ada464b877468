"""Scenes, parameters, and the files of calibrations and cameras that scenes name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from tests.fuzz.target import target
from us_sim.errors import UsSimError
from us_sim.nodes.settings import NODES, checked_parameters
from us_sim.scene.reading import load_scene
from us_sim.share import shared_roots
from us_sim.tracking.calibration.transform_file import read_transform
from us_sim.tracking.camera.model import read_camera_info
from us_sim.tracking.camera.rigid_body import read_rigid_body

SMALL = Path(__file__).parents[1] / "small_scene.yaml"

MORE = """structures:
  vein:
    flow: {kind: venous, direction: [0, -1, 0], peak_velocity: 20 cm/s, mean_velocity: 7 cm/s}
colour: {width: 0.4, nyquist_velocity: 0.2}
imaging: {gain: 3 dB, time_gain: [0 dB, 3 dB]}
tracker: {source: pose, filter: {method: one_euro}}
"""

CAMERA = """image_width: 640
image_height: 480
camera_name: fuzzed
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.05, 0, 0, 0]}
"""

TRANSFORM = """date: 2025-01-01T00:00:00+00:00
position: [0.01, 0.02, 0.03]
orientation: [0, 0, 0, 1]
"""

BODY = """%YAML:1.0
aruco_bc_dict: ARUCO_MIP_36h12
aruco_bc_nmarkers: 1
aruco_bc_mInfoType: 1
aruco_bc_markers:
  - {id: 7, corners: [[-0.02, 0.02, 0], [0.02, 0.02, 0], [0.02, -0.02, 0], [-0.02, -0.02, 0]]}
"""

PARAMETERS = b"""slice_interpolator
imaging.gain
3 dB
tissue_deformer
solver
fem
session_player
rate
2.0
session_recorder
topics
[/a, /b]
"""


def scene_seeds(_: Path) -> Iterator[bytes]:
    """Everything in one, and those that are installed."""
    small = SMALL.read_text().replace("tissue:\n", "tissue:\n  solver: fem\n")
    yield (small.replace("materials:", "materials: &these") + MORE).encode()
    root = next(iter(shared_roots()))
    for file in sorted((root / "config" / "scenes").glob("upper_arm*.yaml")):
        yield file.read_bytes()


@target("scene", ".yaml", scene_seeds)
def scene(path: Path) -> None:
    """The scene, and what it needs to run."""
    assert load_scene(path).parts()


@target("parameters", ".txt", lambda _: [PARAMETERS])
def parameters(path: Path) -> None:
    """Node, name and text, line by line."""
    lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    of = load_scene("upper_arm")
    for node, name, text in zip(lines[::3], lines[1::3], lines[2::3], strict=False):
        if node in NODES:
            with suppress(UsSimError):
                checked_parameters(node, of, {name: text})


@target("camera-info", ".yaml", lambda _: [CAMERA.encode()])
def camera_info(path: Path) -> None:
    """A camera with numbers."""
    assert np.isfinite(read_camera_info(path).matrix).all()


@target("transform", ".yaml", lambda _: [TRANSFORM.encode()])
def transform(path: Path) -> None:
    """A pose."""
    assert np.isfinite(read_transform(path).position).all()


@target("rigid-body", ".yaml", lambda _: [BODY.encode()])
def rigid_body(path: Path) -> None:
    """A body with markers."""
    assert read_rigid_body(path)
