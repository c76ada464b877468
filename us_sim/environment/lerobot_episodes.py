"""Episodes of a data set as a LeRobot data set.

Features ``observation.…`` are late and noisy as the episode drew it, as a policy will get them;
features ``truth.…`` are of the moment, and exact.
"""

from __future__ import annotations

import inspect
import json
import tarfile
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.environment.tasks import TASKS
from us_sim.errors import EpisodeError
from us_sim.progress import ProgressBar
from us_sim.recording.lerobot_writer import (
    IMAGES,
    POSE_PARTS,
    STATE,
    TWIST_PARTS,
    WRENCH_PARTS,
    Frame,
    LeRobotEpisode,
    write_episodes,
)

_PARTS = {"pose": POSE_PARTS, "goal": POSE_PARTS, "wrench": WRENCH_PARTS, "contact": ("contact",)}
_USED = ("image.png", "labels.png", "json")
_Step = Mapping[str, Any]  # files by their endings; of "json", the object


def convert_shards(
    folder: Path,
    shards: Path,
    episodes: Mapping[str, Mapping[str, Any]],
    task: str | None,
    period: float,
    *,
    is_video: bool,
) -> None:
    """Write a data set's episodes, in the order of their names, as a LeRobot data set.

    Args:
        folder: of the LeRobot data set; a whole one that is there stays.
        shards: folder of the episodes' tar files.
        episodes: facts of each episode, by its name.
        task: of the episodes, a name in `TASKS`, if any.
        period: s, of a step.
        is_video: code images as video, which loses speckle.

    Raises:
        EpisodeError: lerobot is not installed, the folder cannot be written or has other episodes,
            or episodes differ in their labels, observations or sizes of images.
    """
    if folder.exists():
        _require_whole(folder, len(episodes))
        return
    about = inspect.getdoc(TASKS[task]) if task else "Scan the skin."
    with ProgressBar("writing for LeRobot", len(episodes), "episodes") as bar:

        def read_episodes() -> Iterator[LeRobotEpisode]:
            for done, (name, facts) in enumerate(sorted(episodes.items()), 1):
                frames, names = read_episode(shards / f"{name}.tar", facts)
                yield LeRobotEpisode(frames, names, str(about), f"{name} of {facts['scene']}")
                bar.update(done)

        write_episodes(folder, compute_frame_rate(period), read_episodes(), is_video=is_video)


def compute_frame_rate(period: float) -> int:
    """Return the frames a second of steps of a period (s).

    Raises:
        EpisodeError: they are no whole number.
    """
    rate = round(1 / period)
    if abs(rate * period - 1) > 1e-6:
        raise EpisodeError(
            f"episode.period: {period:g} s makes {1 / period:g} steps a second, and LeRobot needs "
            f"a whole number: set it to {1000 / rate:.9g} ms"
        )
    return rate


def read_episode(
    shard: Path, facts: Mapping[str, Any]
) -> tuple[Iterator[Frame], Mapping[str, Sequence[str]]]:
    """Read an episode's tar file: its frames, and the names of each feature's numbers."""
    steps = _read_steps(shard)
    return _make_frames(steps, facts), _name_numbers(steps[0], facts)


def _read_steps(shard: Path) -> list[_Step]:
    """Read the files of each step that a frame is made of."""
    members: dict[str, dict[str, Any]] = {}
    with shard.open("rb") as stream, tarfile.open(fileobj=stream, mode="r|") as tar:
        for member in tar:
            name, _, ending = member.name.partition(".")
            content = tar.extractfile(member)
            if content is not None and ending in _USED:
                members.setdefault(name, {})[ending] = content.read()
    return [step | {"json": json.loads(step["json"])} for step in members.values()]


def _name_numbers(step: _Step, facts: Mapping[str, Any]) -> dict[str, Sequence[str]]:
    """Name the numbers of each feature, and the labels."""
    record = step["json"]
    state = [f"{name}.{part}" for name in sorted(record["observed"]) for part in _PARTS[name]]
    return {
        STATE: state,
        "action": TWIST_PARTS,  # of the probe's velocity in its frame, -1 to 1
        "truth.pose": POSE_PARTS,
        "truth.wrench": WRENCH_PARTS,
        "truth.areas": sorted(record.get("areas", ())),
        "truth.labels": [f"{number} {name}" for number, name in facts["labels"].items()],
    }


def _make_frames(steps: Sequence[_Step], facts: Mapping[str, Any]) -> Iterator[Frame]:
    late: deque[NDArray[np.uint8]] = deque(maxlen=facts["draw"]["delay"] + 1)
    for step in steps:
        record = step["json"]
        late.append(_decode_png(step["image.png"]))
        frame: dict[str, NDArray[Any]] = {f"{IMAGES}ultrasound": late[0]}
        if observed := record["observed"]:
            frame[STATE] = _float32(np.concatenate([observed[name] for name in sorted(observed)]))
        frame["action"] = _float32(record["action"])
        if "reward" in record:
            frame["next.reward"] = _float32([record["reward"]])
            frame["next.success"] = np.array([record["is_success"]])
        frame["next.done"] = np.array([step is steps[-1]])
        frame["truth.pose"] = _float32(record["pose"])
        frame["truth.wrench"] = _float32(record["wrench"])
        frame["truth.is_balanced"] = np.array([record["is_balanced"]])
        frame["truth.contact"] = _float32([record["contact"]])
        if "areas" in record:
            frame["truth.areas"] = _float32([area for _, area in sorted(record["areas"].items())])
            frame["truth.labels"] = _decode_png(step["labels.png"])
        yield frame


def _float32(numbers: Any) -> NDArray[np.float32]:
    return np.array(numbers, np.float32)


def _decode_png(png: bytes) -> NDArray[np.uint8]:
    found = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    return np.asarray(found, np.uint8)


def _require_whole(folder: Path, count: int) -> None:
    """Raise EpisodeError unless the folder is a LeRobot data set of ``count`` episodes."""
    try:
        text = (folder / "meta" / "info.json").read_text(encoding="utf-8")
        has = json.loads(text)["total_episodes"]
    except (OSError, ValueError, TypeError, KeyError):
        has = "no"
    if has != count:
        raise EpisodeError(
            f"{folder}: has {has} episodes of {count}: remove the folder and give the command again"
        )
