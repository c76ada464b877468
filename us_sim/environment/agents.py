"""Agents that are written by hand.

`VisualServo` looks for the largest dark and round spot, as a person looks for a vein, brings it to
the image's middle, presses until it is gone, and lets go.

>>> import numpy as np
>>> from us_sim.environment.agents import find_dark_spots
>>> image = np.full((60, 80), 120, np.uint8)
>>> image[20:32, 30:50] = 5
>>> [spot.centre for spot in find_dark_spots(image)]
[(39.5, 25.5)]
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_SMALLEST, _LARGEST = 0.0015, 0.06
"""Areas of a vessel over that of the image."""
_DARK = 0.45
"""Grey value over the image's median below which a pixel is dark."""
_FILLED = 0.55
"""Part of its box that a spot fills; an ellipse fills 0.79."""


@dataclass(frozen=True)
class Spot:
    """A dark spot in an image."""

    centre: tuple[float, float]  # column, row
    area: int  # pixels


def find_dark_pixels(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return (rows, columns), 1 at pixels that are dark for tissue; all 0 in air."""
    smooth = cv2.GaussianBlur(image, (0, 0), max(image.shape) / 128)
    lit = smooth[smooth > 4]
    if lit.size < 0.3 * image.size:
        return np.zeros_like(image)
    return (smooth < _DARK * np.median(lit)).astype(np.uint8)


def find_dark_spots(image: NDArray[np.uint8]) -> list[Spot]:
    """Find dark spots the size of vessels, off the image's border, the largest first."""
    rows, columns = image.shape
    _, _, stats, centres = cv2.connectedComponentsWithStats(find_dark_pixels(image))
    found = []
    for (left, top, width, height, area), centre in zip(stats[1:], centres[1:], strict=True):
        inside = left > 0 and top > 0 and left + width < columns and top + height < rows
        sized = _SMALLEST * image.size < area < _LARGEST * image.size
        if inside and sized and area > _FILLED * width * height:
            found.append(Spot((float(centre[0]), float(centre[1])), int(area)))
    return sorted(found, key=lambda spot: -spot.area)


class VisualServo:
    """An agent that finds the vein in the image, presses until it is not seen, and lets go.

    Its actions are those of the `twist` control. It uses the entry `image` alone.

    Args:
        press: press the vein once it is in the middle; else only bring it there.

    Examples:
        >>> VisualServo().act({"image": np.zeros((60, 80, 1), np.uint8)})  # in the air: down
        array([0.  , 0.  , 0.25, 0.  , 0.  , 0.  ], dtype=float32)
    """

    def __init__(self, *, press: bool = True) -> None:
        self._press = press
        self.phase = "approach"
        self._steps = 0  # of the phase
        self._last: Spot | None = None
        self._first_area = 0  # pixels, of the open vein
        self._gone = 0  # steps in a row without the vein

    def act(self, observation: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the next action (6,)."""
        image = np.squeeze(observation["image"])
        spots = find_dark_spots(image)
        x, z = getattr(self, f"_{self.phase}")(image, spots)
        self._steps += 1
        return np.array([x, 0.0, z, 0.0, 0.0, 0.0], np.float32).clip(-1.0, 1.0)

    def _enter_phase(self, phase: str) -> tuple[float, float]:
        self.phase, self._steps = phase, 0
        return 0.0, 0.0

    def _approach(self, image: NDArray[np.uint8], _: list[Spot]) -> tuple[float, float]:
        """Go down until tissue is seen all along the face."""
        rows = len(image)
        depths = image[int(0.45 * rows) : int(0.6 * rows)].mean(axis=0)
        touches = (depths > 10.0).mean() > 0.85
        return self._enter_phase("centre") if touches or self._steps > 80 else (0.0, 0.25)

    def _centre(self, image: NDArray[np.uint8], spots: list[Spot]) -> tuple[float, float]:
        """Bring the largest spot to the middle; slide to and fro while there is none."""
        columns = image.shape[1]
        spot = self._find_followed_spot(spots) or (spots[0] if spots else None)
        if spot is None:
            return 0.6 * math.copysign(1.0, math.sin(self._steps / 25)), 0.0
        self._last = spot
        offset = (spot.centre[0] - (columns - 1) / 2) / columns
        if abs(offset) < 0.02 and self._press and self._steps > 5:
            self._first_area = spot.area
            return self._enter_phase("compress")
        # Where it is not pressed later, the whole face is to touch: a tilted one is 4 mm off.
        return 6.0 * offset, 0.0 if self._press or self._steps > 24 else 0.15

    def _compress(self, image: NDArray[np.uint8], spots: list[Spot]) -> tuple[float, float]:
        """Press until almost nothing is dark at the spot's place, and somewhat further."""
        spot = self._find_followed_spot(spots)
        self._last = spot or self._last
        assert self._last is not None
        (x, y), side = self._last.centre, math.sqrt(self._first_area)
        rows, columns = (slice(max(int(c - side), 0), int(c + side) + 1) for c in (y, x))
        left = find_dark_pixels(image)[rows, columns].sum()
        self._gone = self._gone + 1 if left < 0.15 * self._first_area else 0
        if self._gone > 15 or self._steps > 90:
            return self._enter_phase("hold")
        aside = 0.0 if spot is None else 3.0 * (x / (image.shape[1] - 1) - 0.5)
        return aside, 0.25

    def _hold(self, *_: Any) -> tuple[float, float]:
        return self._enter_phase("release") if self._steps >= 10 else (0.0, 0.0)

    def _release(self, *_: Any) -> tuple[float, float]:
        """Lift the probe."""
        return 0.0, -0.4

    def _find_followed_spot(self, spots: list[Spot]) -> Spot | None:
        """Return the spot nearest to the one followed so far; None if it is not near."""
        if self._last is None or not spots:
            return None
        x, y = self._last.centre
        near = min(spots, key=lambda s: math.hypot(s.centre[0] - x, s.centre[1] - y))
        apart = math.hypot(near.centre[0] - x, near.centre[1] - y)
        return near if apart < 1.2 * math.sqrt(self._last.area) else None


class WanderingAgent:
    """Smooth random motion over the skin, pressed and let go about every three seconds."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._action = np.zeros(6)
        self._steps = 0

    def act(self, _: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        """Return the next action (6,): noise that keeps 95 % of itself, and a wave along z."""
        self._action = 0.95 * self._action + 0.1 * self._random.standard_normal(6)
        action = self._action.copy()
        action[2] = 0.35 * math.cos(2 * math.pi * self._steps / 90) + 0.2 * action[2]
        self._steps += 1
        return action.clip(-1.0, 1.0).astype(np.float32)
