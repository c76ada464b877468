"""Two recordings of the same poses held against each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from us_sim.errors import BagError, UsSimError, printable
from us_sim.geometry.se3 import rotation_between
from us_sim.recording.decoding import pixels_from, pose_from, vectors_from, wrench_from
from us_sim.recording.reader import Bag
from us_sim.recording.stamps import stamp_reader
from us_sim.recording.topic import BagMessage
from us_sim.run.session_tables import SECOND, Progress, read_times, write_table
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
    apart = wrench_from(one) - wrench_from(other)
    return float(np.linalg.norm(apart[:3])), 1e3 * float(np.linalg.norm(apart[3:]))


QUANTITIES: dict[str, tuple[list[str], Callable[[Any, Any], Measured]]] = {
    "geometry_msgs/msg/PoseStamped": (["position (mm)", "angle (°)"], _pose_apart),
    "sensor_msgs/msg/PointCloud2": (["nodes, rms (mm)", "nodes, worst (mm)"], _nodes_apart),
    "geometry_msgs/msg/WrenchStamped": (["force (N)", "torque (N mm)"], _wrench_apart),
    "sensor_msgs/msg/Image": (["grey levels, mean", "grey levels, worst"], _image_apart),
}
"""How far apart two decoded messages of a type are."""
HEAD = ("topic", "difference", "pairs", "same", "only A", "only B", "median", "worst", "at (s)")


@dataclass(frozen=True)
class SessionDiff:
    """Two recordings, held against each other."""

    paths: tuple[Path, Path]
    rows: list[tuple[str, ...]]  # below `HEAD`; the time of the worst is since the first pair
    notes: list[str]  # sentences on what differs otherwise, or could not be compared
    left_out: list[str]  # topics of both, of types that are not compared

    @property
    def is_none(self) -> bool:
        """Tell whether every message has its pair, of the same bytes, and all else is the same."""
        return not self.notes and all(row[2:6] == (row[2], row[2], "0", "0") for row in self.rows)


def diff(one: Bag, other: Bag, progress: Progress = lambda *_: None) -> SessionDiff:
    """Compare poses, nodes, wrenches and images of equal stamps in recordings A and B.

    Raises:
        BagError: a recording is damaged, or the two have no topic or no stamp in common.
    """
    mine, yours = (
        {(topic.name, topic.type_name) for topic in bag.topics if topic.message_count}
        for bag in (one, other)
    )
    notes = [
        f"in {bag.path} alone: {', '.join(name for name, _ in sorted(alone))}"
        for bag, alone in ((one, mine - yours), (other, yours - mine))
        if alone
    ]
    both = sorted(mine & yours)
    names = [n for n, t in both if t in QUANTITIES and stamp_reader(one, one.topic(n)) is not None]
    if not names:
        raise BagError(
            f"{one.path} and {other.path} have no poses, nodes, wrenches or images on topics of "
            f"the same names: give two sessions of the same simulator"
        )
    rows: list[tuple[str, ...]] = []
    for k, name in enumerate(names):
        progress(k / len(names), name)
        found, refused = _compare(one, other, name)
        rows += found
        notes += [f"pairs on {name} cannot be compared: {refused}"] if refused else []
    progress(1.0, "")
    if all(row[2] == "0" for row in rows):
        raise BagError(
            f"{one.path} and {other.path} have no stamp in common, so that nothing can be paired: "
            f"they are of different runs; `us-sim render --path` keeps the stamps"
        )
    return SessionDiff(
        (one.path, other.path), rows, notes, sorted({name for name, _ in both} - {*names})
    )


def _compare(one: Bag, other: Bag, name: str) -> tuple[list[tuple[str, ...]], str]:
    """Pair the messages of a topic by their stamps, in the order of recording A.

    Returns:
        Rows below `HEAD`, and why a pair could not be compared.
    """
    columns, measure = QUANTITIES[one.topic(name).type_name]
    mine, yours = (_places(bag, name) for bag in (one, other))
    pairs = mine.merge(yours, on=["stamp", "again"], suffixes=("", "_of_other"))
    identical, refused = 0, ""
    apart = pd.DataFrame(np.zeros((len(pairs), 2)), index=pairs["stamp"], columns=columns)
    firsts = _numbered(one, name, pairs["place"])
    seconds = _numbered(other, name, pairs["place_of_other"])
    for k, (a, b) in enumerate(zip(firsts, seconds, strict=True)):
        # Fast DDS hands on what it received with zeros that fill up the last four bytes.
        if a.data.rstrip(b"\0") == b.data.rstrip(b"\0"):
            identical += 1
            continue
        try:
            apart.iloc[k] = measure(one.deserialize(a), other.deserialize(b))
        except UsSimError as error:
            apart.iloc[k] = np.nan
            refused = refused or str(error)
    only = len(mine) - len(pairs), len(yours) - len(pairs)
    counts = [str(count) for count in (len(pairs), identical, *only)]
    rows = []
    for column, values in apart.items():
        told = ["-", "-", "-"]
        if values.notna().any():
            since = (values.idxmax() - apart.index[0]) / SECOND
            told = [f"{values.median():.4g}", f"{values.max():.4g}", f"{since:.3f}"]
        rows.append((name, str(column), *counts, *told))
    return rows, refused


def _places(bag: Bag, name: str) -> pd.DataFrame:
    """List the stamps of a topic with their places, and the number of each stamp's repetition."""
    found = read_times(bag, [name])[name].query("is_short == 0")[["stamp"]]
    return found.assign(again=found.groupby("stamp").cumcount(), place=found.index)


def _numbered(bag: Bag, name: str, places: pd.Series) -> Iterator[BagMessage]:
    """Read the messages of a topic that have these places, in this order."""
    messages = enumerate(bag.messages([name]))
    wanted, waiting = {*places}, dict[int, BagMessage]()
    for place in places:
        while place not in waiting:
            number, message = next(messages)
            if number in wanted:
                waiting[number] = message
        yield waiting.pop(place)


def table(found: SessionDiff) -> str:
    """Write the numbers below each other, and what could not be compared."""
    rows = aligned([HEAD, *found.rows], left=(0, 1))
    lines = [f"A {found.paths[0]}", f"B {found.paths[1]}", "", *rows, "", *found.notes]
    if found.left_out:
        lines.append(f"not compared: {', '.join(found.left_out)}")
    if found.is_none:
        pairs = sum(int(row[2]) for row in found.rows) // 2
        lines.append(f"all {counted(pairs, 'pair is', 'pairs are')} equal")
    return "\n".join(printable(line) for line in lines)


def write(found: SessionDiff, folder: Path) -> Path:
    """Write the numbers as ``diff.csv``; return its path.

    Raises:
        BagError: it is there already, or cannot be written.
    """
    return write_table(folder / "diff.csv", pd.DataFrame(found.rows, columns=list(HEAD)))
