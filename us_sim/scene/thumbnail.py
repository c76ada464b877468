"""A small picture of what the probe sees in a scene before it presses, kept once it was made."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import tempfile
from pathlib import Path

import cv2
import numpy as np

from us_sim.cache import cache_folder
from us_sim.geometry.pose import Pose
from us_sim.scene.building import scanner_of, volume_of
from us_sim.scene.scene import Scene

WIDTH, HEIGHT = 240, 180
"""Pixels."""
_QUALITY = 85
_FORM = 1
"""Raised when another picture is made of the same scene."""


def thumbnail_file(scene: Scene) -> Path:
    """The JPEG file in the cache folder, made if it is not there.

    Raises:
        UsSimError: what the scene names cannot be read.
        OSError: the file cannot be written.
    """
    folder = cache_folder() / "thumbnails"
    file = folder / f"{_key(scene)}.jpg"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        data = _jpeg(scene)
        with tempfile.NamedTemporaryFile(dir=folder, delete=False) as partial:
            partial.write(data)
        Path(partial.name).rename(file)
    return file


def _key(scene: Scene) -> str:
    """Tells apart what looks different: the volume, the probe and how grey values are made."""
    source = scene.volume.case or scene.volume.file
    changed = 0
    if source:
        path = Path(source)
        files = sorted(path.glob("*.nrrd")) if scene.volume.case else [path]
        changed = max((file.stat().st_mtime_ns for file in files if file.is_file()), default=0)
    about = [_FORM, repr(scene.volume), changed, repr(scene.probe), repr(scene.imaging)]
    return hashlib.sha256(json.dumps(about).encode()).hexdigest()[:24]


def _jpeg(scene: Scene) -> bytes:
    """The image at rest, with all of the probe's face on the skin, in its true shape on black."""
    scene = dataclasses.replace(scene, imaging=dataclasses.replace(scene.imaging, contact=False))
    scanner = scanner_of(scene, volume_of(scene))
    sides = np.array([scanner.probe.width, scanner.probe.height])
    columns, rows = np.maximum(np.rint(sides * (np.array([WIDTH, HEIGHT]) / sides).min()), 1)
    fitted = cv2.resize(
        scanner.image(Pose()), (int(columns), int(rows)), interpolation=cv2.INTER_AREA
    )
    picture = np.zeros((HEIGHT, WIDTH), np.uint8)
    top, left = (HEIGHT - fitted.shape[0]) // 2, (WIDTH - fitted.shape[1]) // 2
    picture[top : top + fitted.shape[0], left : left + fitted.shape[1]] = fitted
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return bytes(data)
