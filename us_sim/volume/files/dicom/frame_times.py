"""When the images of a cine were made, from its first one on.

>>> import pydicom.data
>>> from us_sim.volume.files.dicom.frame_times import frame_times
>>> from us_sim.volume.files.dicom.header import open_dicom
>>> file = open_dicom(pydicom.data.get_testdata_file("examples_ybr_color.dcm"))
>>> [round(time, 3) for time in frame_times(file, 4)]
[0.0, 0.033, 0.067, 0.1]
"""

from __future__ import annotations

import math
from itertools import accumulate

from us_sim.volume.files.dicom.header import DicomFile
from us_sim.volume.files.dicom.values import number, numbers

__all__ = ["frame_times"]

_MILLISECONDS = 1e-3


def frame_times(file: DicomFile, frames: int) -> list[float] | None:
    """Times in s from the first image on; None where the header does not state them.

    `FrameTimeVector` says how long after the one before it each image came, `FrameTime` and the
    rates say it of all (PS3.3, C.7.6.5).
    """
    header = file.header
    steps = numbers(header, "FrameTimeVector", frames)
    if steps and all(0.0 <= step < 1e7 for step in steps[1:]):
        return list(accumulate((step * _MILLISECONDS for step in steps[1:]), initial=0.0))
    step = number(header, "FrameTime")
    if not step or not 0.0 < step < 1e7:
        rate = number(header, "CineRate") or number(header, "RecommendedDisplayFrameRate")
        step = 1.0 / rate / _MILLISECONDS if rate and rate > 1e-3 else math.nan
    if math.isnan(step):
        return [0.0] if frames == 1 else None
    return [frame * step * _MILLISECONDS for frame in range(frames)]
