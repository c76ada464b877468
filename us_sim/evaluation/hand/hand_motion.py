"""Random, smooth paths of a probe in a free hand, of a given speed and seed."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import erf

from us_sim.geometry.pose import Pose

RATE = 60.0
"""Poses per second."""
APPROACH = 0.5
"""s before a motion, in which the probe comes to its start."""
_Array = NDArray[np.float64]
_Point = tuple[float, float, float]


class HandSpeed(NamedTuple):
    """Speeds of a hand: medians over a motion."""

    speed: float  # m/s, of the probe's face
    turning: float  # rad/s


HASTES = {
    "careful": HandSpeed(0.020, math.radians(30)),
    "brisk": HandSpeed(0.060, math.radians(90)),
    "violent": HandSpeed(0.300, math.radians(360)),
}
"""By name, from a sonographer who looks to one who breaks things."""


@dataclass(frozen=True)
class HandMotion:
    """A kind of motion: ranges of the probe's position and rotation.

    The middle of the probe's face is between two points in ``patient``, whose xy plane is the skin;
    rotations are from upright.
    """

    words: str
    low: _Point  # m
    high: _Point  # m
    turn: _Point = (0.0, 0.0, 0.0)  # rad to either side: about z, then the probe's x and y
    steep: float = 1.0  # preference of coordinates for the ends of their ranges; 1: none


_TILT = math.radians(25)
KINDS = {
    "free": HandMotion(
        "all six degrees of freedom, in the air and in the tissue",
        (-0.018, -0.012, -0.005),
        (0.018, 0.012, 0.015),
        (math.radians(90), _TILT, _TILT),
    ),
    "pressing": HandMotion("down and up in one place", (0.0, 0.0, -0.005), (0.0, 0.0, 0.015)),
    "sliding": HandMotion(  # the tissue of the scene `upper_arm` ends at 36 mm
        "pressed, off an edge of the tissue and back onto it",
        (0.018, -0.0024, 0.0045),
        (0.045, 0.0024, 0.0105),
    ),
    "tilting": HandMotion(
        "pressed, tilting to all sides",
        (0.0, 0.0, 0.0075),
        (0.0, 0.0, 0.0075),
        (0.0, _TILT, _TILT),
    ),
    "stabbing": HandMotion(
        "lifted, put elsewhere and stabbed in again",
        (-0.018, -0.012, -0.005),
        (0.018, 0.012, 0.015),
        steep=1.8,
    ),
}
"""By name."""


def make_hand_motion(kind: str, haste: str, seed: int, duration: float = 5.0) -> list[Pose]:
    """Make a random motion of a hand, and its approach from above the skin.

    Each coordinate follows a sum of waves of a narrow band of frequencies and random phases, which
    the error function maps to the coordinate's range: it is about uniform in the range, and never
    outside. The curves' tempo is chosen for the median speed, and for the median turning, of the
    haste.

    Args:
        kind: one of `KINDS`.
        haste: one of `HASTES`.
        seed: not negative; another seed gives another motion.
        duration: s, without the approach.

    Returns:
        ``RATE * (APPROACH + duration)`` poses in frame ``patient``.
    """
    motion, wanted = KINDS[kind], HASTES[haste]
    low, high, angles = np.array([motion.low, motion.high, motion.turn])
    # The same number must not give the kinds' coordinates the same curves.
    random = np.random.default_rng([seed, zlib.crc32(f"{kind} {haste}".encode())])
    moving, turning = _make_curves(random, motion.steep), _make_curves(random, motion.steep)

    def compute_positions(times: _Array) -> _Array:
        return np.asarray(low + (high - low) * moving(times))

    def compute_rotations(times: _Array) -> Rotation:
        return Rotation.from_euler("ZXY", angles * (2 * turning(times) - 1))

    def measure_speeds(times: _Array) -> _Array:
        return np.asarray(RATE * np.linalg.norm(np.diff(compute_positions(times), axis=0), axis=1))

    def measure_turning(times: _Array) -> _Array:
        turned = compute_rotations(times)
        return np.asarray(RATE * (turned[:-1].inv() * turned[1:]).magnitude())

    approaching = round(RATE * APPROACH)
    times = np.arange(round(RATE * duration)) / RATE
    begun = np.concatenate([np.zeros(approaching), times])
    positions = compute_positions(
        begun * (_find_tempo(measure_speeds, wanted.speed, times) if np.any(high > low) else 0.0)
    )
    turns = compute_rotations(
        begun * (_find_tempo(measure_turning, wanted.turning, times) if angles.any() else 0.0)
    )
    part = np.arange(approaching) / approaching
    # From rest to rest as a hand moves (Flash and Hogan 1985).
    smooth = part**3 * (10 - 15 * part + 6 * part**2)
    present = np.concatenate([smooth, np.ones_like(times)])[:, None]
    # On the straight way from 10 mm above the skin, upright.
    hover = np.array([0.0, 0.0, -0.010])
    positions = hover + present * (positions - hover)
    orientations = Rotation.from_rotvec(present * turns.as_rotvec()).as_quat()
    return [Pose(*placed) for placed in zip(positions, orientations, strict=True)]


def _make_curves(random: np.random.Generator, steep: float) -> Callable[[_Array], _Array]:
    """Make three random curves of times (K,), with values (K, 3) from 0 to 1."""
    count = 6
    frequency = random.uniform(0.4, 1.6, (count, 3))  # cycles of the curve's own unit of time
    phase = random.uniform(0.0, 2 * np.pi, (count, 3))

    def evaluate_curves(times: _Array) -> _Array:
        waves = np.sin(2 * np.pi * frequency * times[:, None, None] + phase).sum(axis=1)
        # Its variance is half the number of waves; of a normal variable this is uniform.
        return np.asarray(0.5 + 0.5 * erf(steep * waves / math.sqrt(count)))

    return evaluate_curves


def _find_tempo(speeds: Callable[[_Array], _Array], asked: float, times: _Array) -> float:
    """Find the tempo, units of a curve in a second, for which its median speed is ``asked``."""

    def compute_excess(tempo: float) -> float:
        return float(np.median(speeds(tempo * times))) - asked

    high = 1e-4
    while compute_excess(high) < 0.0:
        high *= 2.0
    return float(brentq(compute_excess, 0.5 * high, high))
