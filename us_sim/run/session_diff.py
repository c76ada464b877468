"""Two recordings of the same poses held against each other: are they the same, and where not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from us_sim.errors import BagError, UsSimError, printable
from us_sim.geometry.se3 import rotation_between
from us_sim.recording.decoding import pixels_from, pose_from, vectors_from
from us_sim.recording.reader import Bag
from us_sim.recording.stamps import stamp_reader
from us_sim.recording.topic import BagMessage, BagTopic
from us_sim.run.session_tables import SECOND, Progress, read_times
from us_sim.settings.spelling import aligned, counted

Measured = tuple[float, float]


def _pose_apart(one: Any, other: Any) -> Measured:
    a, b = pose_from(one), pose_from(other)
    angle = np.degrees(np.linalg.norm(rotation_between(a.orientation, b.orientation)))
    return 1e3 * float(np.linalg.norm(a.position - b.position)), float(angle)


def _nodes_apart(one: Any, other: Any) -> Measured:
    a, b = vectors_from(one), vectors_from(other)
    if a.shape != b.shape:
        raise BagError(f"{len(a)} points against {len(b)}")
    apart = 1e3 * np.linalg.norm(a - b, axis=1)
    return float(np.sqrt(np.mean(apart**2))), float(apart.max(initial=0.0))


def _image_apart(one: Any, other: Any) -> Measured:
    a, b = pixels_from(one), pixels_from(other)
    if a.shape != b.shape:
        raise BagError(f"an image of {a.shape} pixels against one of {b.shape}")
    apart = np.abs(a.astype(np.int16) - b)
    return float(apart.mean()), float(apart.max())


def _wrench_apart(one: Any, other: Any) -> Measured:
    a, b = one.wrench, other.wrench
    force, torque = (
        [getattr(u, n) - getattr(v, n) for n in "xyz"]
        for u, v in ((a.force, b.force), (a.torque, b.torque))
    )
    return float(np.linalg.norm(force)), 1e3 * float(np.linalg.norm(torque))


QUANTITIES: dict[str, tuple[list[str], Callable[[Any, Any], Measured]]] = {
    "geometry_msgs/msg/PoseStamped": (["position (mm)", "angle (°)"], _pose_apart),
    "sensor_msgs/msg/PointCloud2": (["nodes, rms (mm)", "nodes, worst (mm)"], _nodes_apart),
    "geometry_msgs/msg/WrenchStamped": (["force (N)", "torque (N mm)"], _wrench_apart),
    "sensor_msgs/msg/Image": (["grey levels, mean", "grey levels, worst"], _image_apart),
}
"""How far apart two decoded messages of a type are."""
HEAD = ("topic", "difference", "pairs", "same", "only A", "only B", "median", "worst", "at (s)")


@dataclass
class Difference:
    """One topic of both recordings."""

    topic: str
    apart: pd.DataFrame  # quantities, with units, by the stamps of the pairs (ns)
    identical: int = 0  # pairs of the same bytes
    only: tuple[int, int] = (0, 0)  # messages that the other one has not
    refused: str = ""  # why a pair could not be compared

    @property
    def is_none(self) -> bool:
        """Whether there is none: every message has its pair, of the same bytes."""
        return self.only == (0, 0) and self.identical == len(self.apart)

    @property
    def rows(self) -> Iterator[tuple[str, ...]]:
        """The numbers below `HEAD`; the time of the worst is since the first pair."""
        counts = [str(n) for n in (len(self.apart), self.identical, *self.only)]
        for name, values in self.apart.items():
            told = ["-", "-", "-"]
            if values.notna().any():
                since = (values.idxmax() - self.apart.index[0]) / SECOND
                told = [f"{values.median():.4g}", f"{values.max():.4g}", f"{since:.3f}"]
            yield (self.topic, str(name), *counts, *told)


@dataclass(frozen=True)
class SessionDiff:
    """Two recordings, held against each other."""

    paths: tuple[Path, Path]
    topics: list[Difference]
    notes: list[str]  # sentences on what differs otherwise, or could not be compared
    left_out: list[str]  # topics of both, of types that are not compared

    @property
    def is_none(self) -> bool:
        """Whether the two are equal in all that is compared."""
        return all(each.is_none for each in self.topics) and not self.notes

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """The numbers below `HEAD`."""
        return [row for each in self.topics for row in each.rows]


def diff(one: Bag, other: Bag, progress: Progress = lambda *_: None) -> SessionDiff:
    """Compare poses, nodes, wrenches and images of equal stamps.

    Args:
        one: recording A.
        other: recording B.
        progress: takes the fraction done, and what is being compared.

    Raises:
        BagError: a recording is damaged, or the two have no topic or no stamp in common.
    """
    mine, yours = (
        {topic.name: topic.type_name for topic in bag.topics if topic.message_count}
        for bag in (one, other)
    )
    both = mine.keys() & yours.keys()
    names = sorted(
        name
        for name in both
        if mine[name] == yours[name]
        and mine[name] in QUANTITIES
        and stamp_reader(one, one.topic(name)) is not None
    )
    if not names:
        raise BagError(
            f"{one.path} and {other.path} have no poses, nodes, wrenches or images on topics of "
            f"the same names: give two sessions of the same simulator"
        )
    notes = [
        f"in {bag.path} alone: {', '.join(sorted(alone))}"
        for bag, alone in ((one, mine.keys() - both), (other, yours.keys() - both))
        if alone
    ]
    topics: list[Difference] = []
    for k, name in enumerate(names):
        progress(k / len(names), name)
        topics.append(_compare(one, other, one.topic(name)))
        if topics[-1].refused:
            notes.append(f"pairs on {name} cannot be compared: {topics[-1].refused}")
    progress(1.0, "")
    if not any(len(each.apart) for each in topics):
        raise BagError(
            f"{one.path} and {other.path} have no stamp in common, so that nothing can be paired: "
            f"they are of different runs; `us-sim render --session` keeps the stamps"
        )
    return SessionDiff((one.path, other.path), topics, notes, sorted(both - {*names}))


def _compare(one: Bag, other: Bag, topic: BagTopic) -> Difference:
    """Pair the messages of a topic by their stamps, in the order of recording A."""
    columns, measure = QUANTITIES[topic.type_name]
    mine, yours = (_places(bag, topic.name) for bag in (one, other))
    pairs = mine.merge(yours, on=["stamp", "again"], suffixes=("", "_of_other"))
    only = len(mine) - len(pairs), len(yours) - len(pairs)
    found = Difference(topic.name, pd.DataFrame(columns=columns, dtype=float), only=only)
    apart = []
    firsts = _numbered(one, topic.name, pairs["place"])
    seconds = _numbered(other, topic.name, pairs["place_of_other"])
    for a, b in zip(firsts, seconds, strict=True):
        apart.append((0.0, 0.0))
        # Fast DDS hands on what it received with zeros that fill up the last four bytes.
        if a.data.rstrip(b"\0") == b.data.rstrip(b"\0"):
            found.identical += 1
            continue
        try:
            apart[-1] = measure(one.deserialize(a), other.deserialize(b))
        except UsSimError as error:
            apart[-1] = (np.nan, np.nan)
            found.refused = found.refused or str(error)
    found.apart = pd.DataFrame(apart, index=pairs["stamp"], columns=columns, dtype=float)
    return found


def _places(bag: Bag, name: str) -> pd.DataFrame:
    """The stamps of a topic with their places; each once, or with the number of its repetition."""
    found = read_times(bag, [name])[name].query("is_short == 0")[["stamp"]]
    return found.assign(again=found.groupby("stamp").cumcount(), place=found.index)


def _numbered(bag: Bag, name: str, places: pd.Series) -> Iterator[BagMessage]:
    """The messages of a topic that have these places, in this order."""
    messages = enumerate(bag.messages([name]))
    wanted, waiting = {*places}, dict[int, BagMessage]()
    for place in places:
        while place not in waiting:
            number, message = next(messages)
            if number in wanted:
                waiting[number] = message
        yield waiting.pop(place)


def table(found: SessionDiff) -> str:
    """The numbers below each other, and what could not be compared."""
    rows = aligned([HEAD, *found.rows], left=(0, 1))
    lines = [f"A {found.paths[0]}", f"B {found.paths[1]}", "", *rows, "", *found.notes]
    if found.left_out:
        lines.append(f"not compared: {', '.join(found.left_out)}")
    if found.is_none:
        pairs = sum(len(each.apart) for each in found.topics)
        lines.append(f"all {counted(pairs, 'pair is', 'pairs are')} equal")
    return "\n".join(printable(line) for line in lines)


def write(found: SessionDiff, folder: Path) -> Path:
    """The numbers as ``diff.csv``; its path.

    Raises:
        BagError: it is there already, or cannot be written.
    """
    file = folder / "diff.csv"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(found.rows, columns=list(HEAD)).to_csv(file, mode="x", index=False)
    except FileExistsError:
        raise BagError(f"{file} exists already: choose another folder with --out") from None
    except OSError as error:
        raise BagError(f"{file} cannot be written: {error.strerror}") from None
    return file
