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
import re
from collections.abc import Iterator
from datetime import datetime
from itertools import accumulate, pairwise
from typing import Any

from us_sim.volume.files.dicom.header import DicomFile
from us_sim.volume.files.dicom.stated_planes import image_times
from us_sim.volume.files.dicom.values import items, number, numbers, text

_MILLISECONDS = 1e-3
_STAMP = re.compile(r"(\d{14})(\.\d{1,6})?([+-]\d{4})?")  # value representation DT, PS3.5, 6.2


def frame_times(file: DicomFile, frames: int) -> list[float] | None:
    """Times in s from the first image on; None where the header does not state them.

    `FrameTimeVector` says how long after the one before it each image came, `FrameTime` and the
    rates say it of all (PS3.3, C.7.6.5). Without these, images of enhanced objects state their own
    times (PS3.3, C.7.6.16.2).
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
        return [0.0] if frames == 1 else _own_times(file, frames)
    return [frame * step * _MILLISECONDS for frame in range(frames)]


def _own_times(file: DicomFile, frames: int) -> list[float] | None:
    """Of the images' own times those in which each image is later than the one before it."""
    groups = items(file.header, "PerFrameFunctionalGroupsSequence")
    contents = [item for group in groups for item in items(group, "FrameContentSequence")[:1]]
    keys = ("FrameReferenceDateTime", "FrameAcquisitionDateTime")
    for times in (image_times(file, frames), *(_since_first(contents, key) for key in keys)):
        if len(times) == frames and all(a < b for a, b in pairwise(times)):
            return [time - times[0] for time in times]
    return None


def _since_first(contents: list[Any], key: str) -> list[float]:
    """Times in s of the items that state them."""
    stamps = list(_stamps(contents, key))
    return [(stamp - stamps[0]).total_seconds() for stamp in stamps]


def _stamps(contents: list[Any], key: str) -> Iterator[datetime]:
    for item in contents:
        if found := _STAMP.fullmatch(text(item, key)):
            day, part, zone = found.groups("")
            try:
                stated = f"{day}{part or '.0'}{zone or '+0000'}"
                yield datetime.strptime(stated, "%Y%m%d%H%M%S.%f%z")
            except ValueError:  # no such day, hour or zone
                continue
