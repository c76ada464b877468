"""Probe paths as a free hand moves them: smooth, random, as fast as asked, the same for a seed."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.special import erf

from us_sim.recording.path import ProbePath
from us_sim.recording.press_and_slide import EPOCH

RATE = 60.0
"""Poses per second."""
_Array = NDArray[np.float64]
_Curve = Callable[[_Array], _Array]


@dataclass(frozen=True)
class Haste:
    """How fast a hand is: medians over a motion."""

    speed: float  # m/s, of the probe's face
    turning: float  # rad/s


HASTES: Mapping[str, Haste] = MappingProxyType(
    {
        "careful": Haste(0.020, math.radians(30)),
        "brisk": Haste(0.060, math.radians(90)),
        "violent": Haste(0.300, math.radians(360)),
    }
)
"""By name, from a sonographer who looks to one who wants to break something."""


@dataclass(frozen=True)
class Room:
    """The room that a hand takes: by default as much as the scene ``upper_arm`` has.

    Lengths are those of the middle of the probe's face from the origin of ``patient``, whose xy
    plane is the skin, and angles those of the probe from upright.
    """

    aside: float = 0.018  # m, to either side along x
    across: float = 0.012  # m, to either side along y
    above: float = 0.005  # m, over the skin
    deepest: float = 0.015  # m, under it
    tilt: float = math.radians(25)  # rad, to either side, about each of the probe's x and y
    yaw: float = math.radians(90)  # rad, to either side, about z
    edge: float = 0.036  # m, where the tissue ends along x


@dataclass(frozen=True)
class HandMotion:
    """A kind of motion: the fractions of the room that it takes."""

    words: str
    aside: float = 0.0  # of ``aside``, to either side
    across: float = 0.0  # of ``across``, to either side
    depth: tuple[float, float] = (0.5, 0.5)  # of ``deepest``, below 0 of ``above``; from and to
    tilt: float = 0.0  # of ``tilt``
    yaw: float = 0.0  # of ``yaw``
    over_the_edge: bool = False  # along x from half of ``edge`` to a quarter beyond it
    steep: float = 1.0  # how much a coordinate prefers the ends of its range; 1: none

    @property
    def moves(self) -> bool:
        """Whether the probe's face leaves its place."""
        return bool(self.aside or self.across or self.over_the_edge or len(set(self.depth)) > 1)

    @property
    def turns(self) -> bool:
        """Whether the probe turns."""
        return bool(self.tilt or self.yaw)


KINDS: Mapping[str, HandMotion] = MappingProxyType(
    {
        "free": HandMotion(
            "all six degrees of freedom, in the air and in the tissue",
            aside=1.0,
            across=1.0,
            depth=(-1.0, 1.0),
            tilt=1.0,
            yaw=1.0,
        ),
        "pressing": HandMotion("down and up in one place", depth=(-1.0, 1.0)),
        "sliding": HandMotion(
            "pressed, off an edge of the tissue and back onto it",
            across=0.2,
            depth=(0.3, 0.7),
            over_the_edge=True,
        ),
        "tilting": HandMotion("pressed, tilting to all sides", tilt=1.0),
        "stabbing": HandMotion(
            "lifted, put elsewhere and stabbed in again",
            aside=1.0,
            across=1.0,
            depth=(-1.0, 1.0),
            steep=1.8,
        ),
    }
)
"""By name. A kind that only moves, or only turns, does the other not at all."""


def hand_motion(
    kind: str,
    haste: str,
    seed: int,
    duration: float = 5.0,
    room: Room | None = None,
    *,
    approach: float = 0.0,
) -> ProbePath:
    """Make a random motion of a hand.

    Each coordinate follows a sum of waves of a narrow band of frequencies and random phases, which
    the error function maps to the coordinate's range: it is everywhere in it about equally often,
    and never outside. How fast the curves are run through is chosen so that the median of the speed
    from pose to pose is the one asked for, and the median of the turning likewise.

    Args:
        kind: one of `KINDS`.
        haste: one of `HASTES`.
        seed: not negative; another number gives another motion.
        duration: s.
        room: how far it goes.
        approach: s before the motion, in which the probe comes from above the skin to where that
            begins; its speed is none of the motion's.

    Returns:
        ``RATE * (approach + duration)`` poses on ``/tracker/pose`` in frame ``patient``.
    """
    motion, asked, room = KINDS[kind], HASTES[haste], room or Room()
    # The same number must not give the kinds' coordinates the same curves.
    random = np.random.default_rng([seed, zlib.crc32(f"{kind} {haste}".encode())])
    place, turn = _place(motion, room, random), _turn(motion, room, random)
    coming = round(RATE * approach)
    times = np.arange(round(RATE * duration)) / RATE
    moving = _tempo(lambda t: _lengths(place(t)), asked.speed, times) if motion.moves else 0.0
    turning = _tempo(lambda t: _angles(turn(t)), asked.turning, times) if motion.turns else 0.0
    begun = np.concatenate([np.zeros(coming), times])
    positions, turns = place(moving * begun), turn(turning * begun)
    present = np.concatenate(
        [_minimum_jerk(np.arange(coming) / max(coming, 1)), np.ones_like(times)]
    )
    # On the straight way from 10 mm above the skin, upright.
    hover = np.array([0.0, 0.0, -0.010])
    positions = hover + present[:, None] * (positions - hover)
    turns = Rotation.from_rotvec(present[:, None] * turns.as_rotvec())
    stamps = EPOCH + np.round(np.arange(len(begun)) / RATE * 1e9).astype(np.int64)
    return ProbePath("/tracker/pose", "patient", stamps, positions, turns.as_quat())


def _place(motion: HandMotion, room: Room, random: np.random.Generator) -> _Curve:
    """Positions (K, 3) m at times (K,)."""
    side, across = motion.aside * room.aside, motion.across * room.across
    low, high = (part * (room.deepest if part > 0 else room.above) for part in motion.depth)
    # Over the edge it turns back a quarter beyond it.
    aside = (0.5 * room.edge, 1.25 * room.edge) if motion.over_the_edge else (-side, side)
    ranges = np.array([aside, (-across, across), (low, high)])
    curve = _wander(random, motion.steep)
    return lambda times: ranges[:, 0] + (ranges[:, 1] - ranges[:, 0]) * curve(times)


def _turn(
    motion: HandMotion, room: Room, random: np.random.Generator
) -> Callable[[_Array], Rotation]:
    """Rotations at times (K,): the yaw first, then about the axes of the turned probe."""
    angles = np.array([motion.yaw * room.yaw, motion.tilt * room.tilt, motion.tilt * room.tilt])
    curve = _wander(random, motion.steep)
    return lambda times: Rotation.from_euler("ZXY", angles * (2 * curve(times) - 1))


def _wander(random: np.random.Generator, steep: float) -> _Curve:
    """Three random curves of times (K,), with values (K, 3) from 0 to 1."""
    count = 6
    frequency = random.uniform(0.4, 1.6, (count, 3))  # cycles of the curve's own unit of time
    phase = random.uniform(0.0, 2 * np.pi, (count, 3))

    def curve(times: _Array) -> _Array:
        waves = np.sin(2 * np.pi * frequency * times[:, None, None] + phase).sum(axis=1)
        # Its variance is half the number of waves; of a normal variable this is uniform.
        return np.asarray(0.5 + 0.5 * erf(steep * waves / math.sqrt(count)))

    return curve


def _tempo(steps: _Curve, asked: float, times: _Array) -> float:
    """Find how many of its units a curve runs through in a second, so that its steps are as asked.

    ``steps`` are from one of the times (K,) s to the next, of which the median is a speed.
    """

    def excess(tempo: float) -> float:
        return float(np.median(steps(tempo * times))) * RATE - asked

    high = 1e-4
    while excess(high) < 0.0:
        high *= 2.0
    return float(brentq(excess, 0.5 * high, high))


def _lengths(positions: _Array) -> _Array:
    return np.asarray(np.linalg.norm(np.diff(positions, axis=0), axis=1))


def _angles(turns: Rotation) -> _Array:
    return np.asarray((turns[:-1].inv() * turns[1:]).magnitude())


def _minimum_jerk(part: _Array) -> _Array:
    """(K,) from 0 to 1 as a hand moves from rest to rest (Flash and Hogan 1985)."""
    return part**3 * (10 - 15 * part + 6 * part**2)
