"""A recording as it is scored: motion, force, and the cross-sections of vessels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from us_sim import Progress
from us_sim.errors import BagError, ScoreError, UsSimError
from us_sim.recording.decoding import SECOND
from us_sim.recording.path import POSE_STAMPED, ProbePath, is_tracker_recording, read_path
from us_sim.recording.reader import Bag, read_bag
from us_sim.run.session_summary import POSE, read_session, unpack_scene
from us_sim.run.session_tables import WRENCH_STAMPED, list_topics, read_wrenches
from us_sim.scene.building import load_volume
from us_sim.scoring.lumen import find_vessels
from us_sim.scoring.metrics import Force, Scan
from us_sim.scoring.motion import Motion

_SAMPLES = 200  # images of which areas are measured, at least
_RATE = 5.0  # and a second


def read_scan(
    file: Path,
    topic: str | None = None,
    wrench: str | None = None,
    progress: Progress = lambda *_: None,
) -> Scan:
    """Read a session, any other bag with poses, or a tracker's recording.

    Of a session the probe's poses in frame ``patient`` are taken, and areas where its scene is
    attached. Without force or areas the scan says so and has none.

    Args:
        file: the recording.
        topic: of the poses, as for `read_path`.
        wrench: topic of the force; by default ``probe/wrench``, or the only one of its type.
        progress: is called while areas are measured.

    Raises:
        BagError: there are no poses, or what was named is not there.
        ScoreError: the poses are no motion.
    """
    bag = None if is_tracker_recording(file) else read_bag(file)
    types = {each.name: each.type_name for each in bag.topics} if bag is not None else {}
    if topic is None and types.get(POSE) == POSE_STAMPED:
        topic = POSE
    path = read_path(file, topic, option="--topic")
    begin = int(path.stamps.min())
    try:
        seconds = (path.stamps - begin) / SECOND
        motion = Motion(seconds, path.positions, path.orientations)
    except ScoreError as error:
        raise ScoreError(f"{file}: {path.topic}: {error}") from error
    missing = [path.note] if path.note else []
    if bag is None:
        return Scan(motion, missing=(*missing, f"force and areas: {file} holds poses alone"))
    force, truth = None, {}
    try:
        force = _read_force(bag, wrench, begin)
    except ScoreError as error:
        missing.append(f"force: {error}")
    try:
        truth = _measure_vessels(bag, path, progress)
    except UsSimError as error:
        missing.append(f"areas of structures: {error}")
    sections = truth.get("sections", {})
    if truth and not any(np.isfinite(each.fraction).any() for each in sections.values()):
        missing.append(f"areas of structures: no image of {file} cuts a vessel of deformed tissue")
    return Scan(motion, force, missing=tuple(missing), **truth)


def _read_force(bag: Bag, topic: str | None, begin: int) -> Force:
    """Read the force on the probe; ScoreError says why there is none that can be used."""
    if topic is None:
        names = list_topics(bag, WRENCH_STAMPED)
        names = [name for name in names if name.endswith("probe/wrench")] or names
        if len(names) != 1:
            several = f"wrenches on {', '.join(names)}: name one with --wrench"
            raise ScoreError(f"{bag.path} holds {several if names else 'no wrench'}")
        topic = names[0]
    _, wrenches = read_wrenches(bag, topic)
    stamps, newtons = wrenches["stamp"], np.linalg.norm(wrenches[["fx", "fy", "fz"]], axis=1)
    usable = np.isfinite(newtons) & (stamps > stamps.cummax().shift(fill_value=-1)).to_numpy()
    if np.count_nonzero(usable) < 2:
        raise ScoreError(f"{topic} holds fewer than two wrenches that can be used")
    return Force(((stamps[usable] - begin) / SECOND).to_numpy(), newtons[usable])


def _measure_vessels(bag: Bag, path: ProbePath, progress: Progress) -> dict[str, Any]:
    """Measure sections, lines and thrombi of the vessels, at five images a second, 200 or more."""
    if path.topic != POSE:
        raise BagError(f"they are known for the poses on {POSE} only, not {path.topic}")
    with unpack_scene(bag) as scene:
        session = read_session(bag.path)
        samples = max(_SAMPLES, int(_RATE * path.duration))
        lines, thrombi = find_vessels(load_volume(scene))
        meter = session.measure_lumens(scene, samples, lambda part: progress(part, "areas"), lines)
    sections = meter.collect_sections() if meter is not None else {}
    long = {name: sections[name] for name in lines if name in sections}
    return {"sections": long, "lines": lines, "thrombi": thrombi}
