"""LeRobot data sets (version 3.0): frames as arrays in, Parquet with PNG, or MP4, out.

`LeRobotDataset` of the package lerobot writes all of it (https://github.com/huggingface/lerobot).
"""

from __future__ import annotations

import importlib.util
import logging
import shutil
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import EpisodeError, UsSimError

Frame = Mapping[str, NDArray[Any]]
"""Arrays by feature; ``observation.images.…`` are of uint8, grey or red, green and blue."""

IMAGES = "observation.images."
STATE = "observation.state"
POSE_PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw")
WRENCH_PARTS = ("fx", "fy", "fz", "tx", "ty", "tz")
TWIST_PARTS = ("x", "y", "z", "rx", "ry", "rz")
_REMEDY = "pip install 'lerobot[dataset]>=0.4'"
_THREADS = 2  # that compress images


class LeRobotEpisode(NamedTuple):
    """One episode; all of a data set have the same features, of the same shapes and names."""

    frames: Iterable[Frame]  # at least one
    names: Mapping[str, Sequence[str]]  # of the numbers of each feature that is no image
    task: str  # in words, for policies that read
    origin: str  # of the frames, for an error


def require_lerobot() -> None:
    """Refuse at once where lerobot is not installed.

    Raises:
        EpisodeError: it is not.
    """
    if importlib.util.find_spec("lerobot") is None:
        raise EpisodeError(f"lerobot is not installed: {_REMEDY}")


def write_episodes(
    folder: Path, rate: int, episodes: Iterable[LeRobotEpisode], *, is_video: bool = False
) -> None:
    """Write a data set; nothing of it stays where that fails.

    Args:
        folder: that must not be there.
        rate: frames a second.
        episodes: what it is to hold.
        is_video: code ``observation.images.…`` as video, which loses speckle.

    Raises:
        EpisodeError: lerobot cannot be used, the folder is there or cannot be written, or an
            episode is unlike the first.
    """
    if folder.exists():
        raise EpisodeError(f"{folder} exists already: choose another folder")
    try:
        import datasets
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
    except ImportError as error:
        raise EpisodeError(f"lerobot cannot be used: {error}; {_REMEDY}") from error
    datasets.disable_progress_bars()  # one for each episode
    logging.getLogger("datasets").setLevel(logging.ERROR)
    data_set: Any = None
    first, origin = dict[str, Any](), ""
    try:
        for frames, names, task, origin in episodes:
            for frame in frames:
                given = {n: _rgb(v) if n.startswith(IMAGES) else v for n, v in frame.items()}
                features = {n: _feature(n, v, names, is_video) for n, v in given.items()}
                if data_set is None:
                    first = features
                    data_set = LeRobotDataset.create(
                        f"us_sim/{folder.name}",
                        rate,
                        features,
                        root=folder,
                        use_videos=is_video,
                        image_writer_threads=_THREADS,
                    )
                if unlike := [n for n in {**first, **features} if features.get(n) != first.get(n)]:
                    raise EpisodeError(
                        f"{origin}: {unlike[0]} is {features.get(unlike[0])}, and "
                        f"{first.get(unlike[0])} in the first frame of all: a LeRobot data set has "
                        f"the same features everywhere; make one of each kind"
                    )
                data_set.add_frame({**given, "task": task})
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # of its statistics of booleans
                data_set.save_episode()
        data_set.finalize()
        shutil.rmtree(folder / "images", ignore_errors=True)  # empty folders
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, UsSimError) or not isinstance(error, Exception):
            raise
        # lerobot's own are of many kinds
        raise EpisodeError(f"{folder}: {origin} cannot be written: {error}") from error


def _feature(
    name: str, value: NDArray[Any], names: Mapping[str, Sequence[str]], is_video: bool
) -> dict[str, Any]:
    """Describe a feature as lerobot wants it."""
    kind, parts = value.dtype.name, list(names.get(name, [name]))
    if name.startswith(IMAGES):
        kind, parts = "video" if is_video else "image", ["height", "width", "channels"]
    return {"dtype": kind, "shape": value.shape, "names": parts}


def _rgb(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return (rows, columns, 3), since lerobot and its policies know no others."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
