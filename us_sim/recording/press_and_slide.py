"""The probe path of the demo: come down, press, hold, slide and rock, release, lift."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.cache import cache_folder
from us_sim.errors import BagError
from us_sim.recording.path import ProbePath, write_path

EPOCH = 1_700_000_000 * 10**9  # ns
_HOVER = 0.010  # m, height above the skin before and after


def make_press_and_slide(
    rate: float = 60.0,
    duration: float = 10.0,
    depth: float = 0.012,
    slide: float = 0.008,
) -> ProbePath:
    """Make a path that touches flat skin at the origin, presses on it and lets go of it.

    Between its key poses it moves with minimum jerk (Flash and Hogan 1985), as a hand does, so it
    rests for an instant at each of them.

    Args:
        rate: poses per second.
        duration: s; the phases keep their fractions of it.
        depth: m, of the press below the skin.
        slide: m, along y and back; it rocks by 4° for 8 mm, and less for less.

    Returns:
        ``round(rate * duration)`` poses on ``/tracker/pose`` in frame ``patient``.
    """
    times = np.arange(round(rate * duration)) / rate
    phase = times * (10.0 / duration)
    # Keys: times of a path of ten seconds, and values between which it moves smoothly. A height is
    # a fraction: of the hover height above the skin if negative, of the depth if positive.
    press = _minimum_jerk(
        [[1.0, -1.0], [1.5, 0.0], [3.5, 1.0], [7.5, 1.0], [8.7, 0.0], [9.2, -1.0]], phase
    )
    slid = _minimum_jerk([[5.0, 0.0], [6.25, 1.0], [7.5, 0.0]], phase)  # along y, the vessels
    rock = _minimum_jerk([[5.0, 0.0], [5.625, 4.0], [6.875, -4.0], [7.5, 0.0]], phase)  # degrees
    half_angle = min(1.0, abs(slide) / 0.008) * np.radians(rock) / 2
    positions = np.zeros((len(times), 3))
    positions[:, 1] = slide * slid
    positions[:, 2] = press * np.where(press < 0, _HOVER, depth)
    orientations = np.zeros((len(times), 4))
    orientations[:, 0] = np.sin(half_angle)
    orientations[:, 3] = np.cos(half_angle)
    stamps = EPOCH + np.round(times * 1e9).astype(np.int64)
    return ProbePath("/tracker/pose", "patient", stamps, positions, orientations)


def _minimum_jerk(keys: list[list[float]], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (K,) values at times (K,) s, at rest at the keys (N, 2) and outside of them."""
    at, values = np.array(keys).T
    left = np.clip(np.searchsorted(at, times, side="right") - 1, 0, len(at) - 2)
    fraction = np.clip((times - at[left]) / (at[left + 1] - at[left]), 0.0, 1.0)
    blend = fraction**3 * (10 - 15 * fraction + 6 * fraction**2)
    return values[left] + blend * (values[left + 1] - values[left])


def find_pressing_path(depth: float, slide: float = 0.008) -> Path:
    """Return the file of `make_press_and_slide` with that depth and slide, m, to a tenth of a mm.

    Raises:
        BagError: the cache folder cannot be written.
    """
    # 1 is the version of the path, so that no older file is taken for it.
    name = f"press-1-{depth * 1e3:.1f}-mm-slide-{slide * 1e3:.1f}-mm.mcap"
    file = cache_folder() / name
    if file.is_file():
        return file
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{file.name}.", dir=file.parent) as folder:
            partial = Path(folder, file.name)
            path = make_press_and_slide(depth=round(depth, 4), slide=round(slide, 4))
            write_path(partial, path, sidecar=False)
            os.replace(partial, file)
    except OSError as error:
        raise BagError(
            f"{file}: the path of the press cannot be kept ({error.strerror}): set US_SIM_CACHE to "
            f"a folder that can be written"
        ) from error
    return file
