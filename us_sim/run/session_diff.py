"""Two recordings of the same poses held against each other: how far apart they are, in numbers."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from us_sim.errors import BagError, UsSimError, printable
from us_sim.recording.decoding import pixels_from, pose_from, tetrahedra_from, vectors_from
from us_sim.recording.reader import Bag
from us_sim.recording.stamps import stamp_reader
from us_sim.recording.topic import BagMessage
from us_sim.run.resimulation import scene_of
from us_sim.scene.building import scanner_of, volume_of
from us_sim.scoring.lumen import VESSELS
from us_sim.settings.spelling import aligned, counted
from us_sim.tissue.elasticity.material import kind_of

AREAS = 40  # pairs of which areas are compared, evenly over the session
Progress = Callable[[float, str], None]
Measured = tuple[float, ...]


class Quantity(NamedTuple):
    """How far apart two messages of a type are."""

    names: tuple[str, ...]  # with their units
    measure: Callable[[Any, Any], Measured]  # of two decoded messages


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
QUANTITIES = {
    "geometry_msgs/msg/PoseStamped": Quantity(("position (mm)", "angle (°)"), _pose_apart),
    "sensor_msgs/msg/PointCloud2": Quantity(("nodes, rms (mm)", "nodes, worst (mm)"), _nodes_apart),
    "geometry_msgs/msg/WrenchStamped": Quantity(("force (N)", "torque (N mm)"), _wrench_apart),
    IMAGE: Quantity(("grey levels, mean", "grey levels, worst"), _image_apart),
}


@dataclass
class Difference:
    """One topic of both recordings."""

    topic: str
    names: tuple[str, ...]  # of the quantities, with units
    stamps: list[int] = field(default_factory=list)  # (K,) ns, of the pairs
    apart: list[Measured] = field(default_factory=list)  # (K,) one of each quantity
    identical: int = 0  # pairs of the same bytes
    only: tuple[int, int] = (0, 0)  # messages that the other one has not
    refused: str = ""  # why a pair could not be compared

    @property
    def is_none(self) -> bool:
        """Whether there is none: every message has its pair, of the same bytes."""
        return self.only == (0, 0) and self.identical == len(self.stamps)

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Topic, quantity, pairs, identical pairs, only in one, only in the other, median, worst,
        and the time of the worst in s since the first pair."""
        rows = []
        for k, name in enumerate(self.names):
            values = np.array([each[k] for each in self.apart])
            told = ("-", "-", "-")
            if np.isfinite(values).any():
                at = int(np.nanargmax(values))
                since = (self.stamps[at] - self.stamps[0]) * 1e-9
                told = (f"{np.nanmedian(values):.4g}", f"{values[at]:.4g}", f"{since:.3f}")
            counts = (len(self.stamps), self.identical, *self.only)
            rows.append((self.topic, name, *map(str, counts), *told))
        return rows


HEAD = ("topic", "difference", "pairs", "same", "only A", "only B", "median", "worst", "at (s)")


@dataclass(frozen=True)
class SessionDiff:
    """Two recordings, held against each other."""

    paths: tuple[Path, Path]
    topics: list[Difference]
    images: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None  # that differ most
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
    """Compare poses, nodes, wrenches and images of equal stamps, and areas of vessels.

    Stamps are taken to rise, as they do in a session that `us-sim bag check` finds whole.

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
    names = sorted(
        name
        for name, kind in types[0].items()
        if kind in QUANTITIES and types[1].get(name) == kind and _is_compared(one, name)
    )
    if not names:
        raise BagError(
            f"{one.path} and {other.path} have no poses, nodes, wrenches or images on topics of "
            f"the same names: give two sessions of the same simulator"
        )
    notes: list[str] = []
    topics: list[Difference] = []
    images = None
    for bag, mine, yours in ((one, types[0], types[1]), (other, types[1], types[0])):
        if alone := sorted(mine.keys() - yours.keys()):
            notes.append(f"in {bag.path} alone: {', '.join(alone)}")
    left_out = sorted((types[0].keys() & types[1].keys()) - {*names})
    for k, name in enumerate(names):
        progress(k / (len(names) + 1), name)
        found, worst = _compare(one, other, name, QUANTITIES[types[0][name]])
        topics.append(found)
        if types[0][name] == IMAGE and worst is not None and images is None:
            images = pixels_from(worst[0]), pixels_from(worst[1])
        if found.refused:
            notes.append(f"pairs on {name} cannot be compared: {found.refused}")
    if not any(each.stamps for each in topics):
        raise BagError(
            f"{one.path} and {other.path} have no stamp in common, so that nothing can be paired: "
            f"they are of different runs; `us-sim render --session` keeps the stamps"
        )
    progress(len(names) / (len(names) + 1), "areas")
    try:
        areas = _areas(one, other)
        if areas is not None:
            topics.append(areas)
    except UsSimError as error:
        if not all(each.is_none for each in topics):  # else the areas are the same, too
            notes.append(f"areas of vessels are not compared: {error}")
    progress(1.0, "")
    return SessionDiff((one.path, other.path), topics, images, notes, left_out)


def _is_compared(bag: Bag, name: str) -> bool:
    return stamp_reader(bag, bag.topic(name)) is not None


def _messages(bag: Bag, name: str) -> Iterator[tuple[int, BagMessage]]:
    """The messages of a topic with their stamps."""
    read = stamp_reader(bag, bag.topic(name))
    assert read is not None
    for message in bag.messages([name]):
        if len(message.data) >= 12:
            yield read(message.data) or 0, message


def _compare(
    one: Bag, other: Bag, name: str, quantity: Quantity
) -> tuple[Difference, tuple[Any, Any] | None]:
    """One topic, and the two messages that are furthest apart by the last quantity's first."""
    found = Difference(name, quantity.names)
    first, second = _messages(one, name), _messages(other, name)
    a, b = next(first, None), next(second, None)
    only, worst, furthest = [0, 0], None, 0.0
    while a is not None or b is not None:
        if b is None or (a is not None and a[0] < b[0]):
            only[0], a = only[0] + 1, next(first, None)
            continue
        if a is None or b[0] < a[0]:
            only[1], b = only[1] + 1, next(second, None)
            continue
        found.stamps.append(a[0])
        if _are_equal(a[1].data, b[1].data):
            found.identical += 1
            found.apart.append((0.0,) * len(quantity.names))
        else:
            pair = one.deserialize(a[1]), other.deserialize(b[1])
            try:
                found.apart.append(quantity.measure(*pair))
                if found.apart[-1][0] > furthest:
                    worst, furthest = pair, found.apart[-1][0]
            except UsSimError as error:
                found.apart.append((np.nan,) * len(quantity.names))
                found.refused = found.refused or str(error)
        a, b = next(first, None), next(second, None)
    found.only = only[0], only[1]
    return found, worst


def _are_equal(one: bytes, other: bytes) -> bool:
    """Whether two messages are equal but for zeros that fill up the last four bytes.

    Fast DDS hands on what it received with them; what is written without it has none.
    """
    length = min(len(one), len(other))
    rest = one[length:] + other[length:]
    return one[:length] == other[:length] and len(rest) < 4 and not any(rest)


_NODES, _POSES = "/tissue/nodes", "/probe/pose"


def _areas(one: Bag, other: Bag) -> Difference | None:
    """Areas of vessels in the image plane, as both recordings' nodes carry them.

    None where there is no tissue, or the volume has no vessels.

    Raises:
        UsSimError: the scene is not there, or of other files.
    """
    names = {topic.name for topic in one.topics} & {topic.name for topic in other.topics}
    needed = {_NODES, _POSES, "/tissue/rest", "/tissue/tetrahedra"}
    if not needed <= names:
        return None
    with scene_of(one) as scene:
        volume = volume_of(scene)
        vessels = {
            label: name for label, name in volume.label_names.items() if kind_of(name) in VESSELS
        }
        if volume.labels is None or not vessels:
            return None
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
    common = sorted(_stamps(one, _NODES) & _stamps(other, _NODES) & _stamps(one, _POSES))
    picked = np.unique(np.linspace(0, len(common) - 1, min(AREAS, len(common))).astype(int))
    chosen = {common[k] for k in picked}
    if not chosen:
        return None
    poses, mine, yours = (
        _decoded(bag, topic, chosen)
        for bag, topic in ((one, _POSES), (one, _NODES), (other, _NODES))
    )
    pixel = 1e6 * float(np.prod(scanner.probe.pixel_spacing))
    found = Difference("areas of vessels", tuple(f"{name} (mm²)" for name in vessels.values()))
    for stamp in sorted(chosen):
        pose = pose_from(poses[stamp])
        if mine[stamp].data.tobytes() == yours[stamp].data.tobytes():
            apart = (0.0,) * len(vessels)
        else:
            seen = [scanner.labels(pose, vectors_from(each[stamp])) for each in (mine, yours)]
            apart = tuple(
                pixel * abs(int((seen[0] == k).sum()) - int((seen[1] == k).sum())) for k in vessels
            )
        found.stamps.append(stamp)
        found.apart.append(apart)
        found.identical += not any(apart)
    return found


def _stamps(bag: Bag, topic: str) -> set[int]:
    return {stamp for stamp, _ in _messages(bag, topic)}


def _decoded(bag: Bag, topic: str, stamps: set[int]) -> dict[int, Any]:
    return {
        stamp: bag.deserialize(message)
        for stamp, message in _messages(bag, topic)
        if stamp in stamps
    }


def table(found: SessionDiff) -> str:
    """The numbers below each other, and what could not be compared."""
    rows = [HEAD, *found.rows]
    lines = [f"A {found.paths[0]}", f"B {found.paths[1]}", "", *aligned(rows, left=(0, 1))]
    pairs = sum(len(each.stamps) for each in found.topics)
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
        with files[0].open("w", encoding="utf-8", newline="") as stream:
            csv.writer(stream).writerows([HEAD, *found.rows])
        _draw(found, files[1])
    except OSError as error:
        raise BagError(f"{folder} cannot be written to: {error.strerror}") from None
    return files


def _draw(found: SessionDiff, file: Path) -> None:
    """Each quantity that differs over time, and the images that differ most."""
    panels = [
        (each, k)
        for each in found.topics
        for k in range(len(each.names))
        if len(each.stamps) > 1 and any(values[k] for values in each.apart)
    ]
    columns = 3
    rows = -(-len(panels) // columns) or 1
    heights = [2.3] * rows + [4.2] * (found.images is not None)
    figure = Figure(figsize=(4.2 * columns, sum(heights)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"A {found.paths[0]}\nB {found.paths[1]}", fontsize=9, x=0.01, ha="left")
    grid = figure.add_gridspec(len(heights), columns, height_ratios=heights)
    if not panels:
        figure.text(0.02, 0.5, "nothing differs over time")
    first = min((each.stamps[0] for each, _ in panels), default=0)
    for place, (each, k) in enumerate(panels):
        axes = figure.add_subplot(grid[place // columns, place % columns])
        times = (np.array(each.stamps) - first) * 1e-9
        axes.plot(times, [values[k] for values in each.apart], ".-", ms=2, lw=0.7)
        axes.set_title(f"{each.topic}: {each.names[k]}", fontsize=8.5, loc="left")
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
