"""Probe paths as a free hand moves them: smooth, random, as fast as asked, the same for a seed.

`shipped_hand_path` is the one that the project ships as ``bags/hand.mcap``.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import erf

from us_sim.errors import BagError
from us_sim.recording.path import ProbePath
from us_sim.recording.press_and_slide import EPOCH
from us_sim.settings.spelling import unknown

RATE = 60.0
"""Poses per second."""
_Array = NDArray[np.float64]
_Curve = Callable[[_Array], _Array]
_T = TypeVar("_T")


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

    Raises:
        BagError: a range is negative or not finite, or the deepest point not below the skin.
    """

    aside: float = 0.018  # m, to either side along x
    across: float = 0.012  # m, to either side along y
    above: float = 0.005  # m, over the skin
    deepest: float = 0.015  # m, under it
    tilt: float = math.radians(25)  # rad, to either side, about each of the probe's x and y
    yaw: float = math.radians(90)  # rad, to either side, about z
    edge: float = 0.036  # m, where the tissue ends along x

    def __post_init__(self) -> None:
        ranges = (self.aside, self.across, self.above, self.tilt, self.yaw, self.edge)
        if not (all(0 <= x < math.inf for x in ranges) and 0 < self.deepest < math.inf):
            raise BagError(f"a hand cannot have {self}: no range may be negative")


@dataclass(frozen=True)
class HandMotion:
    """A kind of motion: the fractions of the room that it takes."""

    words: str
    aside: tuple[float, float] = (0.0, 0.0)  # of ``aside``, from and to
    across: float = 0.0  # of ``across``, to either side
    depth: tuple[float, float] = (0.5, 0.5)  # of ``deepest``, below 0 of ``above``; from and to
    fan: float = 0.0  # of ``tilt``, about the probe's x, which runs along the array
    rock: float = 0.0  # of ``tilt``, about its y
    yaw: float = 0.0
    over_the_edge: bool = False  # along x from half of ``edge`` to a quarter beyond it
    steep: float = 1.0  # how much a coordinate prefers the ends of its range; 1: none

    @property
    def moves(self) -> bool:
        """Whether the probe's face leaves its place."""
        ranges = (self.aside, self.depth)
        return bool(self.across or self.over_the_edge or any(a != b for a, b in ranges))

    @property
    def turns(self) -> bool:
        """Whether the probe turns."""
        return bool(self.fan or self.rock or self.yaw)


KINDS: Mapping[str, HandMotion] = MappingProxyType(
    {
        "free": HandMotion(
            "all six degrees of freedom, in the air and in the tissue",
            *((-1.0, 1.0), 1.0, (-1.0, 1.0)),
            fan=1.0,
            rock=1.0,
            yaw=1.0,
        ),
        "pressing": HandMotion("down and up in one place", depth=(-1.0, 1.0)),
        "sliding": HandMotion(
            "pressed, off an edge of the tissue and back onto it",
            across=0.2,
            depth=(0.3, 0.7),
            over_the_edge=True,
        ),
        "fanning": HandMotion("pressed, the image plane tilting to both sides", fan=1.0),
        "rocking": HandMotion("pressed, from one end of the array to the other", rock=1.0),
        "stabbing": HandMotion(
            "lifted, put elsewhere and stabbed in again",
            *((-1.0, 1.0), 1.0, (-1.0, 1.0)),
            steep=1.8,
        ),
    }
)
"""By name. A kind that only moves, or only turns, does the other not at all."""


@dataclass(frozen=True, eq=False)
class _Hand:
    """A motion as curves of time, which has no beginning and no end."""

    place: _Curve  # (K,) of its own units of time to (K, 3) m
    turn: _Curve  # likewise to (K, 4) x, y, z, w
    moving: float  # units a second, of the former
    turning: float  # of the latter

    def at(self, times: _Array) -> tuple[_Array, _Array]:
        """Positions (K, 3) and orientations (K, 4) at times (K,) s."""
        return self.place(self.moving * times), self.turn(self.turning * times)


def hand_motion(
    kind: str,
    haste: str,
    seed: int,
    duration: float = 5.0,
    room: Room | None = None,
    *,
    rate: float = RATE,
    approach: float = 0.0,
) -> ProbePath:
    """A random motion of a hand.

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
        rate: poses per second.
        approach: s before the motion, in which the probe comes from above the skin to where that
            begins; its speed is none of the motion's.

    Returns:
        ``round(rate * approach) + round(rate * duration)`` poses on ``/tracker/pose`` in frame
        ``patient``.

    Raises:
        BagError: no such kind or haste, fewer than ten poses, or a room in which so few poses a
            second cannot be so fast.
    """
    if not (0 < rate < math.inf and 10 <= rate * duration < math.inf and seed >= 0):
        raise BagError(
            f"a hand's motion cannot have seed {seed}, duration {duration} and rate {rate}: it "
            f"needs ten poses or more, and no negative seed"
        )
    if not 0 <= approach < math.inf:
        raise BagError(f"a hand's motion cannot have an approach of {approach} s")
    times = np.arange(-round(rate * approach), round(rate * duration)) / rate
    hand = _hand(kind, haste, seed, times[times >= 0], room or Room())
    present = _minimum_jerk(1.0 + times / approach) if approach else np.ones(len(times))
    return _path(times - times[0], *_from_above(present, *hand.at(np.maximum(times, 0.0))))


def shipped_hand_path() -> ProbePath:
    """The path in ``bags/hand.mcap``: ten seconds of a brisk hand on the arm.

    The probe hovers above the skin, comes to where the motion begins, takes half a second to get
    under way and as long to stop at the end, and is lifted off. Its seed is 4.
    """
    motion, approach, ease, lift = 7.0, 1.2, 0.5, 0.8  # s
    # Less than the arm has room for, so that the image hardly ever leaves the phantom.
    tilt, yaw = math.radians(12), math.radians(60)
    room = Room(aside=0.012, across=0.010, deepest=0.013, tilt=tilt, yaw=yaw)
    hand = _hand("free", "brisk", 4, np.arange(round(RATE * motion)) / RATE, room)
    times = np.arange(round(RATE * 10.0)) / RATE
    busy = motion + ease
    positions, orientations = hand.at(_eased(times - approach, busy, ease))
    present = _minimum_jerk(times / approach)
    present *= 1.0 - _minimum_jerk((times - approach - busy) / lift)
    return _path(times, *_from_above(present, positions, orientations))


def _hand(kind: str, haste: str, seed: int, times: _Array, room: Room) -> _Hand:
    """The motion, in its tempo at those times (K,) s."""
    motion, asked = _named(KINDS, kind, "kind"), _named(HASTES, haste, "haste")
    # The same number must not give the kinds' coordinates the same curves.
    random = np.random.default_rng([seed, zlib.crc32(f"{kind} {haste}".encode())])
    place, turn = _place(motion, room, random), _turn(motion, room, random)
    return _Hand(
        place,
        turn,
        _tempo(lambda t: _lengths(place(t)), asked.speed, times, "m/s") if motion.moves else 0.0,
        _tempo(lambda t: _angles(turn(t)), asked.turning, times, "rad/s") if motion.turns else 0.0,
    )


def _named(table: Mapping[str, _T], name: str, subject: str) -> _T:
    if name not in table:
        raise BagError(f"a hand's motion: {subject} {unknown(name, table)}")
    return table[name]


def _place(motion: HandMotion, room: Room, random: np.random.Generator) -> _Curve:
    side, across = np.array(motion.aside) * room.aside, motion.across * room.across
    if motion.over_the_edge:
        side = np.array([0.5, 1.25]) * room.edge  # it turns back a quarter beyond the edge
    low, high = (part * (room.deepest if part > 0 else room.above) for part in motion.depth)
    x, y, z = (_wander(random, motion.steep) for _ in range(3))

    def place(times: _Array) -> _Array:
        ranges = ((x, *side), (y, -across, across), (z, low, high))
        return np.stack([a + (b - a) * curve(times) for curve, a, b in ranges], axis=1)

    return place


def _turn(motion: HandMotion, room: Room, random: np.random.Generator) -> _Curve:
    angles = np.array([motion.yaw * room.yaw, motion.fan * room.tilt, motion.rock * room.tilt])
    curves = [_wander(random, motion.steep) for _ in angles]

    def turn(times: _Array) -> _Array:
        about = angles * (2 * np.stack([curve(times) for curve in curves], axis=1) - 1)
        # The yaw first, then about the axes of the turned probe.
        return np.asarray(Rotation.from_euler("ZXY", about).as_quat())

    return turn


def _wander(random: np.random.Generator, steep: float) -> _Curve:
    """A random curve of times (K,), with values (K,) from 0 to 1."""
    count = 6
    frequency = random.uniform(0.4, 1.6, count)  # cycles of the curve's own unit of time
    phase = random.uniform(0.0, 2 * np.pi, count)

    def curve(times: _Array) -> _Array:
        waves = np.sin(2 * np.pi * frequency * times[:, None] + phase).sum(axis=1)
        # Its variance is half the number of waves; of a normal variable this is uniform.
        return np.asarray(0.5 + 0.5 * erf(steep * waves / math.sqrt(count)))

    return curve


def _tempo(steps: _Curve, asked: float, times: _Array, unit: str) -> float:
    """How many of its units a curve runs through in a second, so that its steps are as asked.

    ``steps`` are from one of the times (K,) s to the next, of which the median is a speed.
    """
    period = times[1] - times[0]

    def speed(tempo: float) -> float:
        return float(np.median(steps(tempo * times))) / period

    low = high = 1e-4
    while speed(high) < asked:
        low, high = high, 2 * high
        if high > 1e4:
            raise BagError(
                f"a hand's motion cannot reach {asked:.3g} {unit} in that room at "
                f"{1 / period:.3g} poses a second: give it more of either"
            )
    for _ in range(60):  # to a double's last digits
        middle = 0.5 * (low + high)
        low, high = (middle, high) if speed(middle) < asked else (low, middle)
    return high


def _lengths(positions: _Array) -> _Array:
    return np.asarray(np.linalg.norm(np.diff(positions, axis=0), axis=1))


def _angles(orientations: _Array) -> _Array:
    turns = Rotation.from_quat(orientations)
    return np.asarray((turns[:-1].inv() * turns[1:]).magnitude())


def _eased(times: _Array, busy: float, ease: float) -> _Array:
    """(K,) s of a clock that takes ``ease`` s to start and as long to stop, within ``busy``.

    It shows 0 before and ``busy - ease`` after.
    """
    begun = np.clip(times, 0.0, busy)
    starting, ending = np.minimum(begun, ease), np.minimum(busy - begun, ease)
    lost = 0.5 * (ease - starting) ** 2 / ease - 0.5 * (ease - ending) ** 2 / ease
    return np.asarray(begun - 0.5 * ease + lost)


def _minimum_jerk(part: _Array) -> _Array:
    """(K,) from 0 to 1 as a hand moves from rest to rest (Flash and Hogan 1985)."""
    part = np.clip(part, 0.0, 1.0)
    return part**3 * (10 - 15 * part + 6 * part**2)


def _from_above(present: _Array, positions: _Array, orientations: _Array) -> tuple[_Array, _Array]:
    """Poses on the straight way from 10 mm above, where ``present`` (K,) is 0, to those given."""
    hover = np.array([0.0, 0.0, -0.010])
    turns = present[:, None] * Rotation.from_quat(orientations).as_rotvec()
    places = hover + present[:, None] * (positions - hover)
    return places, np.asarray(Rotation.from_rotvec(turns).as_quat())


def _path(times: _Array, positions: _Array, orientations: _Array) -> ProbePath:
    stamps = EPOCH + np.round(times * 1e9).astype(np.int64)
    return ProbePath("/tracker/pose", "patient", stamps, positions, orientations)
