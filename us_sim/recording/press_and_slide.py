"""The probe path of the demo: come down, press, hold, slide and rock, release, lift.

``python -m us_sim.recording.press_and_slide FILE.mcap`` writes it as a bag.

>>> from us_sim.recording.press_and_slide import press_and_slide
>>> path = press_and_slide()
>>> len(path), float(path.positions[:, 2].min()), float(path.positions[:, 2].max())
(600, -0.01, 0.012)
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.cache import cache_folder
from us_sim.errors import BagError
from us_sim.recording.path import ProbePath, write_path


def write_where_asked(arguments: Sequence[str], module: str, make: Callable[[], ProbePath]) -> int:
    """Write a path to the file that the one argument names.

    Args:
        arguments: of the command line.
        module: its name, for the usage.
        make: the path.

    Returns:
        The exit status: 0, 1 where the file cannot be written, 2 for other arguments than one.
    """
    if len(arguments) != 1:
        print(f"usage: python -m {module} FILE.mcap", file=sys.stderr)
        return 2
    try:
        # The folder of the project's paths holds one bag per file, so none may claim it.
        write_path(arguments[0], make(), sidecar=False)
    except BagError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


_EPOCH = 1_700_000_000 * 10**9  # ns

_KEYED_DURATION = 10.0
"""Length of the path in the key poses below, s. Each is a time and a value; between them the probe
moves smoothly."""

_SLIDE = np.array([[5.0, 0.0], [6.25, 1.0], [7.5, 0.0]])  # of the slide along y, the vessels
_ROCKS_WHOLLY = 0.008  # m, of slide
_ROCK = np.array([[5.0, 0.0], [5.625, 4.0], [6.875, -4.0], [7.5, 0.0]])  # degrees about x
_PRESS = np.array(
    [[1.0, -1.0], [1.5, 0.0], [3.5, 1.0], [7.5, 1.0], [8.7, 0.0], [9.2, -1.0]],
)
"""Height as a fraction: of the hover height above the skin if negative, of the depth if
positive."""


def press_and_slide(
    rate: float = 60.0,
    duration: float = 10.0,
    depth: float = 0.012,
    hover: float = 0.010,
    slide: float = 0.008,
) -> ProbePath:
    """A path that touches flat skin at the origin, presses on it and lets go of it.

    Between its key poses it moves with minimum jerk (Flash and Hogan 1985), as a hand does, so it
    rests for an instant at each of them.

    Args:
        rate: poses per second.
        duration: s; the phases keep their fractions of it.
        depth: m, of the press below the skin.
        hover: m, height above the skin before and after.
        slide: m, along y and back; it rocks by 4° for 8 mm, and less for less.

    Returns:
        ``round(rate * duration)`` poses on ``/tracker/pose`` in frame ``patient``.

    Raises:
        BagError: a rate or duration is not positive, or a length negative.
    """
    if not (rate > 0 and duration > 0 and depth >= 0 and hover >= 0):
        raise BagError(
            f"a path cannot have rate {rate}, duration {duration}, depth {depth}, hover {hover}: "
            f"the first two must be positive, the others not negative"
        )
    times = np.arange(round(rate * duration)) / rate
    phase = times * (_KEYED_DURATION / duration)
    press = _minimum_jerk(_PRESS, phase)
    rocked = min(1.0, abs(slide) / _ROCKS_WHOLLY)
    half_angle = rocked * np.radians(_minimum_jerk(_ROCK, phase)) / 2
    positions = np.zeros((len(times), 3))
    positions[:, 1] = slide * _minimum_jerk(_SLIDE, phase)
    positions[:, 2] = press * np.where(press < 0, hover, depth)
    orientations = np.zeros((len(times), 4))
    orientations[:, 0] = np.sin(half_angle)
    orientations[:, 3] = np.cos(half_angle)
    stamps = _EPOCH + np.round(times * 1e9).astype(np.int64)
    return ProbePath("/tracker/pose", "patient", stamps, positions, orientations)


def _minimum_jerk(keys: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K,) values at times (K,) s, at rest at each of the keys (N, 2) and outside of them."""
    at, values = keys.T
    left = np.clip(np.searchsorted(at, times, side="right") - 1, 0, len(at) - 2)
    fraction = np.clip((times - at[left]) / (at[left + 1] - at[left]), 0.0, 1.0)
    blend = fraction**3 * (10 - 15 * fraction + 6 * fraction**2)
    return values[left] + blend * (values[left + 1] - values[left])


def main(arguments: list[str]) -> int:
    """Writes the path where the one argument says; returns the exit status."""
    return write_where_asked(arguments, "us_sim.recording.press_and_slide", press_and_slide)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))


_MADE = 1
"""Version of `press_and_slide`'s path, so that no older file is taken for it."""


def pressing_path(depth: float, slide: float = 0.008) -> Path:
    """The file of `press_and_slide` with that depth and slide (m), to a tenth of a millimetre.

    Raises:
        BagError: the cache folder cannot be written.
    """
    name = f"press-{_MADE}-{depth * 1e3:.1f}-mm-slide-{slide * 1e3:.1f}-mm.mcap"
    file = cache_folder() / name
    if file.is_file():
        return file
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{file.name}.", dir=file.parent) as folder:
            partial = Path(folder, file.name)
            path = press_and_slide(depth=round(depth, 4), slide=round(slide, 4))
            write_path(partial, path, sidecar=False)
            os.replace(partial, file)
    except OSError as error:
        raise BagError(
            f"{file}: the path of the press cannot be kept ({error.strerror}): set US_SIM_CACHE to "
            f"a folder that can be written"
        ) from error
    return file
