"""`us-sim calibrate camera`: photos in, camera info and a picture of the coverage out."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from itertools import compress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError
from us_sim.settings.spelling import counted
from us_sim.tracking.calibration.camera import (
    INTRINSICS,
    Board,
    BoardView,
    CameraCalibration,
    calibrate_camera,
)
from us_sim.tracking.calibration.report_picture import draw_coverage
from us_sim.tracking.calibration.settings import CameraSettings, Progress
from us_sim.tracking.camera.model import write_camera_info
from us_sim.tracking.settings import columns_and_rows

_IMAGES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"}


def calibrate_photos(settings: CameraSettings, progress: Progress | None = None) -> str:
    """Calibrate a camera and write its info and a picture; returns a sentence with the result.

    Args:
        settings: the photos, what they show, the camera's name, and the file to write.
        progress: told the fraction of the photos that is done, and how many show the board.

    Raises:
        CalibrationError: the photos cannot be read or do not determine the camera, or a file to
            write exists.
    """
    out, picture = settings.out, settings.picture
    lengths = (settings.square, settings.marker, settings.separation)
    markers = settings.dictionary or ("" if settings.board == "chessboard" else "4X4_50")
    shape = columns_and_rows(settings.size)
    board = Board(settings.board, *shape, *lengths, markers, settings.legacy)
    photos = find_photos(settings.photos)
    names, views, blank, size = _views(photos, board, progress)
    if not views:
        raise CalibrationError(
            f"none of the {len(photos)} photos shows the board: check --board, --size and "
            f"--dictionary, and try --legacy with an old ChArUco board"
        )
    found = calibrate_camera(views, *size)
    far_off = list(compress(names, ~found.used))
    names, views = list(compress(names, found.used)), list(compress(views, found.used))
    notes = _notes(found, board, names, views)
    notes |= {"photos_without_board": blank, "photos_left_out": far_off}
    write_camera_info(out, found.camera, settings.name, notes)
    draw_coverage(picture, found, views, names)
    focal = " and ".join(
        f"{intrinsic} {found.camera.matrix[k, k]:.1f} ± {found.deviations[k]:.1f}"
        for k, intrinsic in enumerate(INTRINSICS[:2])
    )
    said = f"{out}: {focal} pixels, RMS {found.rms:.3f} pixels in {counted(len(views), 'photo')}, "
    said += f"coverage in {picture}"
    if blank:
        said += f"; {len(blank)} without the board: {', '.join(blank)}"
    if far_off:
        said += f"; {len(far_off)} left out that fit far worse: {', '.join(far_off)}"
    return f"{said}; {found.note}" if found.note else said


def find_photos(patterns: Sequence[str]) -> list[Path]:
    """The files that are named, lie in named folders or match patterns, in natural order.

    Raises:
        CalibrationError: a name stands for no photo.
    """
    photos: dict[Path, None] = {}
    for text in patterns:
        path = Path(os.path.expanduser(text))
        if path.is_file():
            photos[path] = None
            continue
        if path.is_dir():
            candidates = list(path.iterdir())
        else:
            candidates = [Path(match) for match in glob.glob(str(path), recursive=True)]
        matches = [file for file in candidates if file.suffix.lower() in _IMAGES]
        if not matches:
            raise CalibrationError(f"{text}: there is no such photo, and no folder with any")
        photos.update(dict.fromkeys(sorted(matches, key=_natural)))
    return list(photos)


def _natural(path: Path) -> list[tuple[bool, int, str]]:
    """A sort key that puts 2.jpg before 10.jpg."""
    parts = re.findall(r"\d+|\D+", str(path))
    return [(not part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]


def _views(
    photos: Sequence[Path], board: Board, progress: Progress | None
) -> tuple[list[str], list[BoardView], list[str], tuple[int, int]]:
    """Names and views of the photos that show the board, names of those that do not, the size."""
    names, views, blank = [], [], []
    size: tuple[int, int] | None = None
    for k, photo in enumerate(photos):
        image = _read(photo)
        columns_rows = (image.shape[1], image.shape[0])
        if size is not None and columns_rows != size:
            raise CalibrationError(
                f"{photo}: has {columns_rows[0]} × {columns_rows[1]} pixels and the photos "
                f"before it {size[0]} × {size[1]}: all must come from one camera at one size"
            )
        size = columns_rows
        view = board.find(image)
        if view is None:
            blank.append(photo.name)
        else:
            names.append(photo.name)
            views.append(view)
        if progress is not None:
            progress((k + 1) / len(photos), f"{len(views)} with the board")
    if size is None:
        raise CalibrationError("no photo is given; name files, a folder or a pattern")
    return names, views, blank, size


def _read(photo: Path) -> NDArray[np.uint8]:
    """Grey values (rows, columns), turned by nothing: a calibration is of the sensor."""
    data = np.fromfile(photo, np.uint8)
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if len(data) else None
    if image is None:
        raise CalibrationError(f"{photo}: is no image that can be read")
    return np.asarray(image, np.uint8)


def _notes(
    found: CameraCalibration, board: Board, names: Sequence[str], views: Sequence[BoardView]
) -> dict[str, object]:
    """What the file says in addition to the camera; ROS' readers ignore it."""
    return {
        "method": f"{board.kind} board {board.columns}x{board.rows}, Zhang",
        "residuals": {
            "rms": found.rms,  # pixels
            "photos": dict(zip(names, found.residuals.tolist(), strict=True)),  # RMS, pixels
            "corners": sum(len(view) for view in views),
        },
        "standard_deviations": dict(zip(INTRINSICS, found.deviations.tolist(), strict=True)),
        "largest_tilt": found.tilt,  # rad, between two boards
        "reach": found.reach,  # fraction of the distance from the image's middle to its corners
        "note": found.note,
    }
