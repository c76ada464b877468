"""Two recordings of the same poses held against each other: how far apart they are, in numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from us_sim.errors import BagError, UsSimError, printable
from us_sim.recording.decoding import pixels_from, pose_from, tetrahedra_from, vectors_from
from us_sim.recording.reader import Bag
from us_sim.recording.stamps import stamp_reader
from us_sim.recording.topic import BagMessage, BagTopic
from us_sim.run.resimulation import scene_of
from us_sim.scene.building import scanner_of, volume_of
from us_sim.scoring.lumen import VESSELS
from us_sim.settings.spelling import aligned, counted
from us_sim.tissue.elasticity.material import kind_of

AREAS = 40  # pairs of which areas are compared, evenly over the session
Progress = Callable[[float, str], None]
Measured = tuple[float, float]


def _pose_apart(one: Any, other: Any) -> Measured:
    a, b = one.pose, other.pose
    apart = [getattr(a.position, n) - getattr(b.position, n) for n in "xyz"]
    first, second = (
        np.array([q.x, q.y, q.z, q.w]) / (np.linalg.norm([q.x, q.y, q.z, q.w]) or np.nan)
        for q in (a.orientation, b.orientation)
    )
    # From the chord: the angle's cosine has no digits left where the two are close.
    chord = min(float(np.linalg.norm(first - second)), float(np.linalg.norm(first + second)))
    angle = 4.0 * float(np.arcsin(min(chord / 2.0, 1.0))) if np.isfinite(chord) else np.nan
    return 1e3 * float(np.linalg.norm(apart)), float(np.degrees(angle))


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


IMAGE = "sensor_msgs/msg/Image"
QUANTITIES: dict[str, tuple[list[str], Callable[[Any, Any], Measured]]] = {
    "geometry_msgs/msg/PoseStamped": (["position (mm)", "angle (°)"], _pose_apart),
    "sensor_msgs/msg/PointCloud2": (["nodes, rms (mm)", "nodes, worst (mm)"], _nodes_apart),
    "geometry_msgs/msg/WrenchStamped": (["force (N)", "torque (N mm)"], _wrench_apart),
    IMAGE: (["grey levels, mean", "grey levels, worst"], _image_apart),
}
"""How far apart two decoded messages of a type are."""
HEAD = ("topic", "difference", "pairs", "same", "only A", "only B", "median", "worst", "at (s)")


@dataclass
class Difference:
    """One topic of both recordings."""

    topic: str
    apart: pd.DataFrame  # quantities, with units, by the stamps of the pairs (ns)
    identical: int  # pairs of the same bytes
    only: tuple[int, int] = (0, 0)  # messages that the other one has not
    refused: str = ""  # why a pair could not be compared
    worst: tuple[Any, Any] | None = None  # messages that are furthest apart

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
                since = (values.idxmax() - self.apart.index[0]) * 1e-9
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

    @property
    def images(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
        """The two that differ most, of the first topic whose images do."""
        shown = (each.worst for each in self.topics if "grey levels, mean" in each.apart)
        pair = next(filter(None, shown), None)
        return (pixels_from(pair[0]), pixels_from(pair[1])) if pair else None


def diff(one: Bag, other: Bag, progress: Progress = lambda *_: None) -> SessionDiff:
    """Compare poses, nodes, wrenches and images of equal stamps, and areas of vessels.

    Args:
        one: recording A, whose scene says where vessels are.
        other: recording B.
        progress: takes the fraction done, and what is being compared.

    Raises:
        BagError: a recording is damaged, or the two have no topic or no stamp in common.
    """
    types = [
        {topic.name: topic.type_name for topic in bag.topics if topic.message_count}
        for bag in (one, other)
    ]
    both = types[0].keys() & types[1].keys()
    names = sorted(
        name
        for name in both
        if types[0][name] in QUANTITIES
        and types[1][name] == types[0][name]
        and stamp_reader(one, one.topic(name)) is not None
    )
    if not names:
        raise BagError(
            f"{one.path} and {other.path} have no poses, nodes, wrenches or images on topics of "
            f"the same names: give two sessions of the same simulator"
        )
    notes: list[str] = []
    topics: list[Difference] = []
    for bag, mine in zip((one, other), types, strict=True):
        if alone := sorted(mine.keys() - both):
            notes.append(f"in {bag.path} alone: {', '.join(alone)}")
    for k, name in enumerate(names):
        progress(k / (len(names) + 1), name)
        topics.append(_compare(one, other, one.topic(name)))
        if topics[-1].refused:
            notes.append(f"pairs on {name} cannot be compared: {topics[-1].refused}")
    if not any(len(each.apart) for each in topics):
        raise BagError(
            f"{one.path} and {other.path} have no stamp in common, so that nothing can be paired: "
            f"they are of different runs; `us-sim render --session` keeps the stamps"
        )
    progress(len(names) / (len(names) + 1), "areas")
    try:
        topics += _areas(one, other)
    except UsSimError as error:
        if not all(each.is_none for each in topics):  # else the areas are the same, too
            notes.append(f"areas of vessels are not compared: {error}")
    progress(1.0, "")
    return SessionDiff((one.path, other.path), topics, notes, sorted(both - {*names}))


def _messages(bag: Bag, name: str) -> Iterator[tuple[int, BagMessage]]:
    """The messages of a topic with their stamps."""
    read = stamp_reader(bag, bag.topic(name))
    assert read is not None
    for message in bag.messages([name]):
        if len(message.data) >= 12:
            yield read(message.data) or 0, message


def _places(bag: Bag, name: str) -> pd.DataFrame:
    """The stamps of a topic; each once, or with the number of its repetition."""
    found = pd.DataFrame({"stamp": [stamp for stamp, _ in _messages(bag, name)]}, dtype="int64")
    return found.assign(again=found.groupby("stamp").cumcount())


def _compare(one: Bag, other: Bag, topic: BagTopic) -> Difference:
    """Pair the messages of a topic by their stamps, in the order of recording A."""
    columns, measure = QUANTITIES[topic.type_name]
    mine, yours = _places(one, topic.name), _places(other, topic.name)
    yours["place"] = yours.index
    partner = mine.merge(yours, "left", on=["stamp", "again"])["place"]
    paired = {*partner.dropna()}
    only = len(mine) - len(paired), len(yours) - len(paired)
    found = Difference(topic.name, pd.DataFrame(), 0, only)
    waiting: dict[int, BagMessage] = {}  # of B, that come in another order than in A
    numbered = enumerate(message for _, message in _messages(other, topic.name))
    later = (each for each in numbered if each[0] in paired)
    stamps, apart, furthest = [], [], 0.0
    for (stamp, a), place in zip(_messages(one, topic.name), partner, strict=True):
        if np.isnan(place):
            continue
        while place not in waiting:
            number, message = next(later)
            waiting[number] = message
        b = waiting.pop(int(place))
        stamps.append(stamp)
        apart.append((0.0, 0.0))
        if _are_equal(a.data, b.data):
            found.identical += 1
            continue
        pair = one.deserialize(a), other.deserialize(b)
        try:
            apart[-1] = measure(*pair)
            if apart[-1][0] > furthest:
                found.worst, furthest = pair, apart[-1][0]
        except UsSimError as error:
            apart[-1] = (np.nan, np.nan)
            found.refused = found.refused or str(error)
    found.apart = pd.DataFrame(apart, index=stamps, columns=columns, dtype=float)
    return found


def _are_equal(one: bytes, other: bytes) -> bool:
    """Whether two messages are equal but for zeros that fill up the last four bytes.

    Fast DDS hands on what it received with them; what is written without it has none.
    """
    length = min(len(one), len(other))
    rest = one[length:] + other[length:]
    return one[:length] == other[:length] and len(rest) < 4 and not any(rest)


_NODES, _POSES = "/tissue/nodes", "/probe/pose"


def _areas(one: Bag, other: Bag) -> list[Difference]:
    """Areas of vessels in the image plane, as both recordings' nodes carry them.

    Nothing where there is no tissue, or the volume has no vessels.

    Raises:
        UsSimError: the scene is not there, or of other files.
    """
    names = {topic.name for topic in one.topics} & {topic.name for topic in other.topics}
    needed = {_NODES, _POSES, "/tissue/rest", "/tissue/tetrahedra"}
    if not needed <= names:
        return []
    with scene_of(one) as scene:
        volume = volume_of(scene)
        vessels = {
            label: name for label, name in volume.label_names.items() if kind_of(name) in VESSELS
        }
        if volume.labels is None or not vessels:
            return []
        scanner = scanner_of(scene, volume)
    latched: dict[str, Any] = {
        message.topic: one.deserialize(message)
        for message in one.messages(["/tissue/rest", "/tissue/tetrahedra"])
    }
    if len(latched) < 2:
        raise BagError(f"{one.path} has no mesh")
    scanner.carry(
        vectors_from(latched["/tissue/rest"]), tetrahedra_from(latched["/tissue/tetrahedra"])
    )
    stamps = [{stamp for stamp, _ in _messages(bag, _NODES)} for bag in (one, other)]
    common = sorted(stamps[0] & stamps[1] & {stamp for stamp, _ in _messages(one, _POSES)})
    picked = np.unique(np.linspace(0, len(common) - 1, min(AREAS, len(common))).astype(int))
    chosen = [common[k] for k in picked]
    if not chosen:
        return []
    poses, mine, yours = (
        {s: bag.deserialize(message) for s, message in _messages(bag, topic) if s in {*chosen}}
        for bag, topic in ((one, _POSES), (one, _NODES), (other, _NODES))
    )
    pixel = 1e6 * float(np.prod(scanner.probe.pixel_spacing))
    areas = []
    for stamp in chosen:
        pose = pose_from(poses[stamp])
        seen = [scanner.labels(pose, vectors_from(each[stamp])) for each in (mine, yours)]
        counts = [np.array([(labels == k).sum() for k in vessels]) for labels in seen]
        areas.append(pixel * np.abs(counts[0] - counts[1]))
    apart = pd.DataFrame(areas, chosen, [f"{name} (mm²)" for name in vessels.values()])
    return [Difference("areas of vessels", apart, int((apart == 0).all(axis=1).sum()))]


def table(found: SessionDiff) -> str:
    """The numbers below each other, and what could not be compared."""
    rows = [HEAD, *found.rows]
    lines = [f"A {found.paths[0]}", f"B {found.paths[1]}", "", *aligned(rows, left=(0, 1))]
    pairs = sum(len(each.apart) for each in found.topics)
    lines += ["", *found.notes]
    if found.left_out:
        lines.append(f"not compared: {', '.join(found.left_out)}")
    if found.is_none:
        lines.append(f"all {counted(pairs, 'pair is', 'pairs are')} equal")
    return "\n".join(printable(line) for line in lines)


def write(found: SessionDiff, folder: Path) -> list[Path]:
    """The numbers as ``diff.csv``, and over time as ``diff.png``; their paths.

    Raises:
        BagError: they are there already, or cannot be written.
    """
    files = [folder / "diff.csv", folder / "diff.png"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file in files:
            if file.exists():
                raise BagError(f"{file} exists already: choose another folder with --out")
        pd.DataFrame(found.rows, columns=list(HEAD)).to_csv(files[0], index=False)
        _draw(found, files[1])
    except OSError as error:
        raise BagError(f"{folder} cannot be written to: {error.strerror}") from None
    return files


def _draw(found: SessionDiff, file: Path) -> None:
    """Each quantity that differs over time, and the images that differ most."""
    panels = [
        (f"{each.topic}: {name}", values)
        for each in found.topics
        for name, values in each.apart.items()
        if len(values) > 1 and values.any()
    ]
    columns = 3
    rows = -(-len(panels) // columns) or 1
    heights = [2.3] * rows + [4.2] * (found.images is not None)
    figure = Figure(figsize=(4.2 * columns, sum(heights)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"A {found.paths[0]}\nB {found.paths[1]}", fontsize=9, x=0.01, ha="left")
    grid = figure.add_gridspec(len(heights), columns, height_ratios=heights)
    if not panels:
        alone = [
            f"{each.topic}: {each.only[0]} messages in A alone, {each.only[1]} in B alone"
            for each in found.topics
            if any(each.only)
        ]
        told = "\n".join(["no pair differs over time", *alone, *found.notes])
        figure.text(0.02, 0.5, told, va="center", wrap=True)
    first = min((values.index[0] for _, values in panels), default=0)
    for place, (title, values) in enumerate(panels):
        axes = figure.add_subplot(grid[place // columns, place % columns])
        axes.plot((values.index - first) * 1e-9, values, ".-", ms=2, lw=0.7)
        axes.set_title(title, fontsize=8.5, loc="left")
        axes.set_ylim(bottom=0.0)
        axes.grid(True, color="0.93")
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.set_xlabel("s since the first pair", fontsize=8)
    if found.images is not None:
        a, b = found.images
        apart = np.abs(a.astype(np.int16) - b)
        shown = (
            ("A, where images differ most", a, 255),
            ("B", b, 255),
            (f"|A - B|, white is {apart.max()}", apart, apart.max()),
        )
        for column, (title, pixels, white) in enumerate(shown):
            axes = figure.add_subplot(grid[-1, column])
            axes.imshow(pixels, cmap="gray", vmin=0, vmax=white)
            axes.set_title(title, fontsize=8.5, loc="left")
            axes.axis("off")
    figure.savefig(file, metadata={"Software": None})
