"""Poses, wrenches, images and areas of a recording as files that other programs read."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from us_sim import Progress
from us_sim.errors import BagError, TrackingError
from us_sim.recording.attached_files import new_file
from us_sim.recording.decoding import SECOND, affine_from
from us_sim.recording.reader import Bag
from us_sim.run.session_lerobot import PIXELS
from us_sim.run.session_summary import read_session, unpack_scene
from us_sim.run.session_tables import (
    WRENCH_STAMPED,
    list_pose_sources,
    list_topics,
    read_times,
    read_values,
    write_table,
)
from us_sim.settings.spelling import format_count

_HELD = {"poses": "poses", "wrench": "wrench", "images": "image", "areas": "scene attached"}
AREAS = 200  # images of which areas are measured, evenly over the session
_UNITS = {
    f"{kind}{axis}": f"{kind}{axis}_{unit}"
    for kind, unit in (("", "m"), ("f", "n"), ("t", "nm"))  # position, force, torque
    for axis in "xyz"
}
"""Names of columns with their units."""


def write_parts(
    bag: Bag, folder: Path, parts: Collection[str], progress: Progress
) -> Iterator[Path | str]:
    """Write some of ``poses``, ``wrench``, ``images`` and ``areas`` of a recording as files.

    What is odd or left out is said in sentences among their names.

    Raises:
        BagError: the bag lacks a part, a file exists, or cannot be written.
        UsSimError: the scene for the areas cannot be read.
    """
    needed = {
        "poses": list_pose_sources(bag),
        "wrench": list_topics(bag, WRENCH_STAMPED),
        "images": list_topics(bag, *PIXELS),
        "areas": [name for name in bag.attachments if name == "scene.yaml"],
    }
    if lacking := [part for part in parts if not needed[part]]:
        missing = " and ".join(f"no {_HELD[part]}" for part in lacking)
        leave = " and ".join(f"--{part}" for part in lacking)
        raise BagError(f"{bag.path} holds {missing}; leave out {leave}")
    for name in [name for part in ("poses", "wrench") if part in parts for name in needed[part]]:
        times, values = read_values(bag, name)
        stamps, logged = times["stamp"].map(_seconds), times["logged"].map(_seconds)
        head = pd.DataFrame({"stamp_s": stamps, "recorded_s": logged, "frame": times["frame"]})
        table = head.join(values.rename(columns=_UNITS))
        yield write_table(folder / f"{_file_name(name)}.csv", table, na_rep="nan")
    if "images" in parts:
        named = needed["images"]
        made = [each for name in named for each in _write_images(bag, name, folder, progress)]
        yield from made
        if not any(isinstance(each, Path) for each in made):
            raise BagError(f"{bag.path} holds no image that can be decoded")
    if "areas" in parts:
        yield _write_areas(bag, folder, progress)


def _write_images(bag: Bag, name: str, folder: Path, progress: Progress) -> Iterator[Path | str]:
    """Write a topic of images as PNG files, and a CSV with stamp and scale of each.

    The files hold their scale as resolution. Images without a stamp have the time of their
    recording.
    """
    stem = folder / _file_name(name)
    spacing = _spacing(bag, name)
    stamps = read_times(bag, [name])[name]
    times = stamps["stamp"].where(stamps["stamp"] != 0, stamps["logged"])
    millimetres = [f"{1e3 * each:.6g}" for each in spacing] or ["", ""]
    scale: dict[str, Any] = {"dpi": tuple(0.0254 / each for each in spacing)} if spacing else {}
    rows, odd = [], []
    for number, raw in enumerate(bag.read_messages([name])):
        progress(number / len(times), name)
        try:
            pixels = PIXELS[raw.type_name](bag.deserialize(raw), "RGB")
        except (BagError, TrackingError) as error:
            odd.append(str(error))
            continue
        file = stem / f"{number:06d}.png"
        with new_file(file) as stream:
            Image.fromarray(pixels).save(stream, "PNG", compress_level=3, **scale)
        rows.append((file.name, _seconds(times[number]), *millimetres))
    progress(1.0, "")
    if odd:
        yield f"{name}: {format_count(len(odd), 'image')} skipped: {odd[0]}"
    if rows:
        columns = ["image", "stamp_s", "column_spacing_mm", "row_spacing_mm"]
        yield write_table(stem.with_suffix(".csv"), pd.DataFrame(rows, columns=columns))
        yield stem


def _write_areas(bag: Bag, folder: Path, progress: Progress) -> Path:
    """Write areas of vessels in the image plane, now and in the same plane of tissue at rest."""
    with unpack_scene(bag) as scene:
        session = read_session(bag.path)
        meter = session.measure_lumens(scene, AREAS, lambda done: progress(done, "areas"))
    sections = meter.collect_comparable_sections() if meter is not None else {}
    if not sections:
        raise BagError(f"{bag.path}: no image of it cuts a vessel that can be measured")
    first = min(session.poses)
    section = next(iter(sections.values()))
    stamps = [_seconds(first + round(SECOND * time)) for time in section.times]
    table = pd.DataFrame({"stamp_s": stamps, "depth_mm": 1e3 * section.depth})
    for name, section in sections.items():
        table[f"{name}_mm2"] = 1e6 * section.area
        table[f"{name}_at_rest_mm2"] = 1e6 * section.at_rest
    return write_table(folder / "areas.csv", table.round(6))


def _file_name(topic: str) -> str:
    return re.sub(r"[^\w.-]", "_", topic.strip("/")) or "topic"


def _seconds(nanoseconds: int) -> str:
    """Write seconds with all nine digits, which a float has not since 1970."""
    return f"{Decimal(int(nanoseconds)).scaleb(-9):.9f}"


def _spacing(bag: Bag, name: str) -> list[float]:
    """Find the m from column to column and from row to row, where the recording says so."""
    matrices = f"{name.rpartition('/')[0]}/image_to_probe"
    if any(each.name == matrices for each in bag.topics):
        for message in bag.read_messages([matrices]):
            spacing = np.linalg.norm(affine_from(bag.deserialize(message))[:3, :2], axis=0)
            return spacing.tolist() if spacing.all() else []
    return []
