"""Fiducial markers: the dictionaries they are from, and where their corners are.

>>> from us_sim.tracking.camera.markers import dictionary, square
>>> dictionary("6X6_250").bytesList.shape[0]
250
>>> square(0.04)[0]
array([-0.02,  0.02,  0.  ])
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.tracking.camera.settings import DICTIONARIES


@lru_cache(maxsize=32)
def dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a name, with or without ``DICT_``.

    Raises:
        TrackingError: there is no such dictionary, or OpenCV is too old to find markers.
    """
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        raise TrackingError(
            f"fiducial markers need OpenCV 4.8 or newer, and OpenCV {cv2.__version__} is "
            f"installed: run pip install 'opencv-python-headless>=4.8', where ROS 2 is with "
            f"--break-system-packages and '<4.12'"
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{proper_name(name)}"))


def proper_name(name: str) -> str:
    """The name as `DICTIONARIES` writes it.

    Raises:
        TrackingError: there is no such dictionary.
    """
    plain = str(name).upper().removeprefix("DICT_")
    for known in DICTIONARIES:
        if known.upper() == plain:
            return known
    raise TrackingError(
        f"there is no marker dictionary '{name}'; choose one of {', '.join(DICTIONARIES)}"
    )


def marker_count(name: str) -> int:
    """How many markers a dictionary has; they are numbered from 0."""
    return int(dictionary(name).bytesList.shape[0])


def family(name: str) -> str:
    """The largest dictionary that has all the markers of this one under the same numbers."""
    bits, _, count = name.rpartition("_")
    return f"{bits}_1000" if count.isdigit() else name


def square(size: float) -> NDArray[np.float64]:
    """(4, 3) m: corners of a marker's black square about its middle, as OpenCV orders them.

    x is to its right, y up and z out of the paper, towards who looks at it; the corners are the
    upper left one and on, clockwise.
    """
    half = 0.5 * size
    return np.array([[-half, half, 0.0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
