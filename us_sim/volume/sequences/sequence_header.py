"""The fields of each frame in the header of a sequence file of Plus: transforms, status, time.

>>> from us_sim.volume.sequences.sequence_header import frame_fields, frame_matrix, frame_time
>>> header = {"NDims": "3", "Seq_Frame0003_Timestamp": "0.5"}
>>> header["Seq_Frame0003_ProbeToTrackerTransform"] = "1 0 0 7 0 1 0 0 0 0 1 0 0 0 0 1"
>>> frames = frame_fields(header)
>>> frame_time(frames[3]), frame_matrix(frames[3], "ProbeToTrackerTransform")[0]
(0.5, array([1., 0., 0., 7.]))
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from us_sim.volume.files.frame_sequence import FRAME_KEY

_LARGEST = 1e7
"""mm, of any transform's numbers, so that products of them stay finite."""


def frame_fields(header: Mapping[str, str]) -> dict[int, dict[str, str]]:
    """The fields of each frame by its number, their names without ``Seq_Frame0000_``."""
    frames: dict[int, dict[str, str]] = {}
    for key, value in header.items():
        if match := FRAME_KEY.fullmatch(key):
            frames.setdefault(int(match[1]), {})[match[2]] = value
    return frames


def frame_matrix(fields: Mapping[str, str], key: str) -> NDArray[np.float64]:
    """A frame's transform (4, 4) as the format holds it: to millimetres, and maybe scaled.

    Raises:
        ValueError: with the reason why it cannot be used: its status is not OK, it is missing, is
            not 16 finite numbers, or is singular.
    """
    if fields.get(f"{key}Status", "OK").upper() != "OK":
        raise ValueError(f"{key}Status is not OK")
    if key not in fields:
        raise ValueError(f"no {key}")
    try:
        numbers = [float(number) for number in fields[key].split()]
        matrix = np.array(numbers).reshape(4, 4)
    except ValueError:
        raise ValueError("a transform that is not 16 numbers") from None
    with np.errstate(all="ignore"):
        steps = np.linalg.norm(matrix[:3, :3], axis=0)
        spans = abs(np.linalg.det(matrix[:3, :3] / steps)) > 1e-6
        spans &= steps.min() > 1.0 / _LARGEST and np.abs(matrix).max() < _LARGEST
    if not (np.isfinite(matrix).all() and spans and np.array_equal(matrix[3], [0, 0, 0, 1])):
        raise ValueError("a transform that is singular or not finite")
    return matrix


def frame_time(fields: Mapping[str, str]) -> float:
    """When the frame was recorded, s of the recorder's clock.

    Raises:
        ValueError: the time is missing or no finite number.
    """
    try:
        time = float(fields["Timestamp"])
    except (KeyError, ValueError):
        time = math.nan
    if not math.isfinite(time):
        raise ValueError("no Timestamp")
    return time
