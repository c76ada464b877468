"""LeRobot data sets (version 3.0): frames as arrays in, Parquet with PNG, or MP4, out.

`LeRobotDataset` of the package lerobot writes all of it (https://github.com/huggingface/lerobot).
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import EpisodeError

Frame = Mapping[str, NDArray[Any]]
"""Arrays by feature; ``observation.images.…`` are of uint8, grey or red, green and blue."""

IMAGES = "observation.images."
STATE = "observation.state"
POSE_PARTS = ("x", "y", "z", "qx", "qy", "qz", "qw")
WRENCH_PARTS = ("fx", "fy", "fz", "tx", "ty", "tz")
_REMEDY = "pip install 'lerobot[dataset]>=0.4'"
_THREADS = 2  # that compress images


def require_lerobot() -> None:
    """Refuse at once where lerobot is not installed.

    Raises:
        EpisodeError: it is not.
    """
    if importlib.util.find_spec("lerobot") is None:
        raise EpisodeError(f"lerobot is not installed: {_REMEDY}")


class LeRobotWriter:
    """A data set in the making, which is in its folder once all of it is written.

    It is a context. The first frame says which features all frames have, and of which shapes.

    Args:
        folder: that must not be there.
        rate: frames a second.
        is_video: code ``observation.images.…`` as video, which loses speckle.

    Raises:
        EpisodeError: lerobot is not installed, the folder is there or cannot be written, or an
            episode is unlike the first.
    """

    def __init__(self, folder: Path, rate: int, *, is_video: bool = False) -> None:
        require_lerobot()
        if folder.exists():
            raise EpisodeError(f"{folder} exists already: choose another folder")
        self._folder, self._rate, self._is_video = folder, rate, is_video
        self._partial = folder.with_name(f".{folder.name}.partial")
        self._first: dict[str, Any] | None = None  # shape and names by feature
        self._dataset: Any = None

    def __enter__(self) -> LeRobotWriter:
        shutil.rmtree(self._partial, ignore_errors=True)  # of one that was killed
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        try:
            if self._dataset is not None and error is None:
                with self._telling():
                    self._dataset.finalize()
                    shutil.rmtree(self._partial / "images", ignore_errors=True)  # empty folders
                    self._partial.rename(self._folder)
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)

    def write_episode(
        self, frames: Iterable[Frame], names: Mapping[str, Sequence[str]], task: str, origin: str
    ) -> None:
        """Write an episode of at least one frame.

        Args:
            frames: of the same features as those of the first episode.
            names: of the numbers of each feature that is no image.
            task: in words, for policies that read.
            origin: of the frames, for an error.
        """
        for frame in frames:
            kinds = {name: (v.shape, list(names.get(name, ()))) for name, v in frame.items()}
            if self._first is None:
                self._first = kinds
                self._dataset = self._create(frame, names)
            for name in sorted(kinds.keys() | self._first.keys()):
                first, now = (each.get(name, "nothing") for each in (self._first, kinds))
                if first != now:
                    raise EpisodeError(
                        f"{origin}: {name} is {now}, and {first} in the first frame of all: a "
                        f"LeRobot data set has the same features everywhere; make one of each kind"
                    )
            given = {n: _rgb(v) if n.startswith(IMAGES) else v for n, v in frame.items()}
            with self._telling():
                self._dataset.add_frame({**given, "task": task})
        with self._telling(), warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of its statistics of booleans
            self._dataset.save_episode()

    def _create(self, frame: Frame, names: Mapping[str, Sequence[str]]) -> Any:
        try:
            import datasets
            from lerobot.datasets.lerobot_dataset import LeRobotDataset
        except ImportError as error:
            raise EpisodeError(f"lerobot cannot be used: {error}; {_REMEDY}") from error
        datasets.disable_progress_bars()  # one for each episode
        logging.getLogger("datasets").setLevel(logging.ERROR)
        features: dict[str, dict[str, Any]] = {}
        for name, value in frame.items():
            kind, shape, parts = value.dtype.name, value.shape, list(names.get(name, [name]))
            if name.startswith(IMAGES):
                kind = "video" if self._is_video else "image"
                shape, parts = (*shape[:2], 3), ["height", "width", "channels"]
            features[name] = {"dtype": kind, "shape": shape, "names": parts}
        with self._telling():
            return LeRobotDataset.create(
                f"us_sim/{self._folder.name}",
                self._rate,
                features,
                root=self._partial,
                use_videos=self._is_video,
                image_writer_threads=_THREADS,
            )

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # lerobot's own are of many kinds
            raise EpisodeError(f"{self._folder}: cannot be written: {error}") from error


def _rgb(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(rows, columns, 3), since lerobot and its policies know no others."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
