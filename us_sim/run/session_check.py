"""Whether a recording is whole: its index, order, gaps, latency, losses, and the pairing of stamps.

Nothing is decoded but the stamps, so that the time goes into reading the file.
"""

from __future__ import annotations

import struct
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import printable
from us_sim.nodes.settings import PoseAgeSettings
from us_sim.nodes.topics import TOPICS, Topic
from us_sim.recording.reader import Bag
from us_sim.recording.stamps import Stamp, stamp_reader
from us_sim.recording.topic import BagTopic, Fault
from us_sim.settings.spelling import aligned, counted

POSES = "probe/pose"
DERIVED = {
    topic.name: topic
    for topic in TOPICS
    if {*topic.publishers} <= {"tissue_deformer", "skin_deformer", "slice_interpolator"}
    and topic.publishers
    and not (topic.latched or topic.on_demand)
}
"""Topics whose messages carry the stamp of the pose that they follow from."""

STALE = round(1e9 * PoseAgeSettings().stale_after)
"""ns without a message after which there is a gap: an image is called stale then."""
_PERIODS = 5  # of a topic, that a gap has at least
_REGULAR = 20  # messages of a topic, from which on its rate is known
_APART = 1_000_000  # ns, by which two clocks may differ unnoticed
_OTHER_TIME = 60 * 10**9  # ns of age, beyond which a stamp is of another recording
_SHARED = ("tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray")
"""Types of topics that many publish at once, each later than it stamps, and heard in any order."""
_SHARED_DELAY = 10**10  # ns, by which their stamps may go back: a busy machine delays one for long
_SEVERAL = 0.01  # of the numbers of a topic, that go back where several publishers count

Times = NDArray[np.int64]


class Finding(NamedTuple):
    """Something that is not as it should be."""

    kind: str  # index, order, gap, latency, loss or stamp
    text: str  # a sentence: what, where, what to do
    matters: bool = True  # else it is only good to know


@dataclass
class TopicCheck:
    """One topic's messages, in the order of their log times."""

    topic: BagTopic
    read_stamp: Stamp | None
    logged: array[int] = field(default_factory=lambda: array("Q"))  # ns
    sent: array[int] = field(default_factory=lambda: array("Q"))  # ns
    stamps: array[int] = field(default_factory=lambda: array("q"))  # ns; 0 where there is none
    numbers: array[int] = field(default_factory=lambda: array("Q"))
    too_short: int = 0  # messages, for their type
    by_another_clock: int = 0  # messages whose log time is of another clock than their sending
    missing: int | None = None  # messages, by their numbers; None without numbers
    longest_gap: float = 0.0  # s
    unpaired: int | None = None  # messages; None where no pose is followed

    @property
    def derived(self) -> Topic | None:
        """The topic of the graph, if its messages follow from poses."""
        found = (each for name, each in DERIVED.items() if self.topic.name.endswith(f"/{name}"))
        return next(found, None) if self.read_stamp else None

    @property
    def ages(self) -> NDArray[np.float64]:
        """(K,) ms from the stamps to the sending, of messages with a stamp."""
        stamps, sent = _times(self.stamps), _times(self.sent)
        return np.asarray((sent - stamps)[stamps != 0] / 1e6)

    @property
    def is_of_another_time(self) -> bool:
        """Whether the stamps are from long before the sending, or after it."""
        ages = self.ages
        return bool(len(ages)) and abs(float(np.median(ages))) > _OTHER_TIME / 1e6

    @property
    def tells_latency(self) -> bool:
        return not (self.topic.is_latched or self.is_of_another_time or self.by_another_clock)

    @property
    def interval(self) -> float | None:
        """ns from message to message as is usual; None where there is no such."""
        if len(self.sent) < _REGULAR or self.topic.is_latched:
            return None
        usual, long = np.percentile(np.diff(np.sort(_times(self.sent))), [50, 90])
        return float(usual) if 0 < long <= 2 * usual else None


@dataclass(frozen=True)
class BagCheck:
    """The findings on a bag."""

    bag: Bag
    topics: list[TopicCheck]  # by name
    findings: list[Finding]
    bytes: int  # of messages
    seconds: float  # that reading took

    @property
    def is_whole(self) -> bool:
        """Whether nothing was found that matters."""
        return not any(finding.matters for finding in self.findings)


def check(bag: Bag, progress: Callable[[float, str], None] = lambda *_: None) -> BagCheck:
    """Read all of a bag and judge it.

    Args:
        bag: of a session or of anything else.
        progress: takes the fraction done, and what is being read.
    """
    began = time.monotonic()
    topics = {topic.name: TopicCheck(topic, stamp_reader(bag, topic)) for topic in bag.topics}
    faults: list[Fault] = []
    read, total, size = 0, max(bag.message_count, 1), 0
    for message in bag.all_messages(faults):
        into = topics[message.topic]
        is_apart = abs(message.log_time - message.publish_time) > _OTHER_TIME
        into.by_another_clock += is_apart
        into.logged.append(message.log_time)
        into.sent.append(message.log_time if is_apart else message.publish_time)
        into.numbers.append(message.sequence)
        into.stamps.append(_stamp(into, message.data))
        size += len(message.data)
        read += 1
        if read % 500 == 0:
            progress(min(read / total, 0.999), message.topic)
    progress(1.0, "")
    held = sorted(topics.values(), key=lambda each: each.topic.name)
    findings = [*_index(bag, faults, read)]
    if apart := sum(each.by_another_clock for each in held):
        findings.append(
            Finding(
                "latency",
                f"{bag.path} was recorded by another clock than that of the sending of "
                f"{counted(apart, 'message')}, as under simulated time: no latency is told of them",
                matters=False,
            )
        )
    one_counter = _count_together(held)
    for each in held:
        origin = bag.start or 0
        findings += _order(each, origin)
        findings += _losses(each, bag.lost()[each.topic.name], origin, one_counter)
        name = each.derived.name if each.derived else ""
        poses = topics.get(f"{each.topic.name.removesuffix(name)}{POSES}") if name else None
        findings += _gaps(each, poses, origin, is_cut=bool(bag.opening_faults))
        findings += _latency(each, origin)
        if poses is not None and poses.read_stamp and len(poses.stamps):
            findings += _pairing(each, poses, origin, is_cut=bool(bag.opening_faults))
    damaged = sum(fault.messages for fault in faults)
    if damaged > 0 and sum(each.missing or 0 for each in held) <= damaged:
        # The damaged parts held what is missing, and the poses of these stamps.
        findings = [finding for finding in findings if finding.kind not in ("loss", "stamp")]
    return BagCheck(bag, held, findings, size, time.monotonic() - began)


def _stamp(topic: TopicCheck, data: bytes) -> int:
    if topic.read_stamp is None:
        return 0
    try:
        return topic.read_stamp(data) or 0
    except (struct.error, IndexError):
        topic.too_short += 1
        return 0


def _times(values: array[int]) -> Times:
    return (
        np.minimum(np.array(values, np.uint64), 2**63 - 1).astype(np.int64)
        if (values.typecode == "Q")
        else np.array(values, np.int64)
    )


def _at(moment: int, origin: int) -> str:
    return f"{(moment - origin) * 1e-9:.3f} s"


def _index(bag: Bag, faults: list[Fault], read: int) -> Iterator[Finding]:
    remedy = f"`us-sim bag repair {bag.path}` writes all that can be read as a new bag"
    for fault in faults:
        yield Finding("index", f"{fault.text}: {remedy}")
    if not bag.is_indexed and not faults:
        yield Finding("index", f"{bag.path} has no sound index, so that it is read whole: {remedy}")
    if bag.metadata is not None and bag.metadata.message_count < bag.message_count:
        yield Finding(
            "index",
            f"{bag.path} holds {bag.message_count} messages where its metadata.yaml says "
            f"{bag.metadata.message_count}: make it anew with `ros2 bag reindex`",
        )
    elif bag.metadata is not None and bag.metadata.message_count == bag.message_count > 0:
        start, end = bag.start or 0, bag.end or 0
        said = bag.metadata.start, bag.metadata.start + bag.metadata.duration
        if max(abs(said[0] - start), abs(said[1] - end)) > _APART:
            yield Finding(
                "index",
                f"{bag.path} has messages from {start} to {end} ns, where its metadata.yaml says "
                f"{said[0]} to {said[1]}: make it anew with `ros2 bag reindex`",
            )
    if not read:
        yield Finding("index", f"{bag.path} holds no message: record again")


def _order(each: TopicCheck, origin: int) -> Iterator[Finding]:
    name, logged = each.topic.name, each.logged
    if each.too_short:
        yield Finding(
            "order",
            f"{name} has {counted(each.too_short, 'message')} too short for a "
            f"{each.topic.type_name}: find out what publishes them",
        )
    stamped = np.flatnonzero(_times(each.stamps))
    may_go_back = _SHARED_DELAY if each.topic.type_name in _SHARED else 0
    back = stamped[1:][np.diff(_times(each.stamps)[stamped]) < -may_go_back]
    if each.read_stamp and len(each.stamps) and not len(stamped) and not each.topic.is_latched:
        yield Finding(
            "order",
            f"all stamps of {name} are 0: let its publisher stamp what it sends",
        )
    if len(back) and not each.topic.is_latched:
        yield Finding(
            "order",
            f"the stamps of {name} go back {counted(len(back), 'time')}, first at "
            f"{_at(logged[back[0]], origin)}: let one node publish it, with one clock",
        )


def _count_together(topics: list[TopicCheck]) -> bool:
    """Whether one counter numbers the messages of all topics, as some writers do."""
    numbers = [np.array(each.numbers) for each in topics if len(each.numbers)]
    together = np.concatenate(numbers) if numbers else np.zeros(0)
    return len(numbers) > 1 and len(np.unique(together)) == len(together)


def _losses(each: TopicCheck, said: int, origin: int, one_counter: bool) -> Iterator[Finding]:
    name, numbers = each.topic.name, np.array(each.numbers, np.int64)
    steps = np.diff(numbers)
    restarts = np.append(False, (steps < 0) & (numbers[1:] <= 1)) if len(numbers) else steps > 0
    back = np.flatnonzero((steps <= 0) & ~restarts[1:])
    first = ""
    if numbers.any() and not one_counter and len(back) <= max(_SEVERAL * len(numbers), 1):
        parts = np.split(numbers, np.flatnonzero(restarts))
        parts = [np.unique(part) for part in parts if len(part)]
        each.missing = sum(int(part[-1] - part[0]) + 1 - len(part) for part in parts)
        edges = [0, *np.flatnonzero(restarts).tolist(), len(numbers)]
        for begin, at, end in zip(edges, edges[1:], edges[2:], strict=False):
            # Who begins anew counts from 1 again; this one went on where the later times end.
            if 0 < numbers[begin] - numbers[at:end].max() <= 1 + _SEVERAL * len(numbers):
                seconds = (each.logged[end - 1] - each.logged[begin]) * 1e-9
                yield Finding(
                    "order",
                    f"the times at which {name} was recorded go back by {seconds:.3f} s, from "
                    f"{_at(each.logged[end - 1], origin)} on: the recorder's clock was set "
                    f"meanwhile, so that what came first is last; let it be set before",
                )
        if len(back) and each.topic.type_name not in _SHARED:
            yield Finding(
                "order",
                f"the numbers of {name} go back {counted(len(back), 'time')}, first at "
                f"{_at(each.logged[back[0] + 1], origin)}: the messages were exchanged or doubled "
                f"after they were recorded; take the recording as it was made",
            )
        jumps = np.flatnonzero(steps > 1)
        if len(jumps):
            first = f", the first after {_at(each.logged[jumps[0]], origin)}"
    remedy = "give session_recorder a larger max_cache_size, and its publisher a depth for a second"
    if each.missing:
        also = f" (the recorder itself counted {said})" if said else ""
        yield Finding(
            "loss",
            f"{counted(each.missing, 'message is', 'messages are')} missing in the numbers of "
            f"{name}{first}{also}: {remedy}",
        )
    elif said:
        lost = f"{counted(said, 'message')} of {name} {'was' if said == 1 else 'were'} lost"
        yield Finding("loss", f"{lost}, as the recorder says: {remedy}")


def _gaps(
    each: TopicCheck, poses: TopicCheck | None, origin: int, *, is_cut: bool
) -> Iterator[Finding]:
    sent, interval = np.sort(_times(each.sent)), each.interval
    name = each.topic.name
    if poses is not None and len(poses.sent) > 1 and not len(sent):
        yield Finding(
            "gap",
            f"{name} has no message, while {len(poses.sent)} poses came: see in the diagnostics "
            f"and the log of {each.derived.publishers[0] if each.derived else 'its node'} why",
        )
        return
    if poses is not None and len(poses.sent) and len(sent):
        # What follows from poses is missed where poses came, and at the end, too.
        came = np.sort(_times(poses.sent))
        end = sent[-1] if is_cut else max(came[-1], sent[-1])
        begins, ends = sent, np.append(sent[1:], end)
        between = np.searchsorted(came, ends) - np.searchsorted(came, begins, "right")
        lengths = ends - begins
        gaps = np.flatnonzero((lengths > STALE) & (between > 1))
    elif interval is not None:
        begins, lengths = sent[:-1], np.diff(sent)
        gaps = np.flatnonzero(lengths > max(STALE, _PERIODS * interval))
    else:
        return
    each.longest_gap = float(lengths.max()) * 1e-9
    if not len(gaps):
        return
    worst = gaps[np.argmax(lengths[gaps])]
    where = f"the longest of {lengths[worst] * 1e-9:.3f} s at {_at(int(begins[worst]), origin)}"
    many = counted(len(gaps), "gap")
    if each.derived is not None and poses is not None:
        node = each.derived.publishers[0]
        yield Finding(
            "gap",
            f"{name} has {many}, {where}, while poses came: see in the diagnostics and the log of "
            f"{node} whether it was too slow or had ended",
        )
    elif interval is not None:
        yield Finding(
            "gap",
            f"{name} has {many}, {where}, where {1e9 / interval:.1f} Hz are usual: see whether its "
            f"publisher or the recording stood still then",
        )


def _latency(each: TopicCheck, origin: int) -> Iterator[Finding]:
    name = each.topic.name
    sent, logged, stamps = _times(each.sent), _times(each.logged), _times(each.stamps)
    clocks = "let the machines' clocks follow one of them (chrony, or NTP)"
    early = np.flatnonzero(logged < sent - _APART)
    if len(early):
        ahead = (sent - logged).max() * 1e-6
        yield Finding(
            "latency",
            f"{counted(len(early), 'message')} of {name} came up to {ahead:.1f} ms before being "
            f"sent, first at {_at(int(logged[early[0]]), origin)}: {clocks}",
        )
    if each.topic.is_latched or each.by_another_clock or not stamps.any():
        return
    if each.is_of_another_time:
        days = float(np.median(each.ages)) / 86_400_000
        yield Finding(
            "latency",
            f"the stamps of {name} are {abs(days):.2f} days {'older' if days > 0 else 'younger'} "
            f"than the recording, as in lockstep or when played as they were: they tell no latency",
            matters=False,
        )
        return
    ahead_of = np.flatnonzero((stamps > sent + _APART) & (stamps != 0))
    if len(ahead_of):
        most = (stamps - sent).max() * 1e-6
        yield Finding(
            "latency",
            f"the stamps of {counted(len(ahead_of), 'message')} of {name} are up to {most:.1f} ms "
            f"after their sending, first at {_at(int(logged[ahead_of[0]]), origin)}: {clocks}",
        )
    old = np.flatnonzero((sent - stamps > STALE) & (stamps != 0))
    if each.derived is not None and len(old):
        yield Finding(
            "latency",
            f"{counted(len(old), 'message')} of {name} followed from poses more than "
            f"{STALE * 1e-9:.1f} s old, first at {_at(int(logged[old[0]]), origin)}: give "
            f"{each.derived.publishers[0]} more processor time, or a coarser scene",
        )


def _pairing(
    each: TopicCheck, poses: TopicCheck, origin: int, *, is_cut: bool
) -> Iterator[Finding]:
    """Find messages without their pose.

    Of those before the first recorded one, and after the last where the bag was cut, nobody knows.
    """
    stamps, known = _times(each.stamps), _times(poses.stamps)
    unknown = (stamps < known.min()) & (stamps > known.min() - 10**9)
    if is_cut:
        unknown |= stamps > known.max()
    alone = np.flatnonzero(~np.isin(stamps, known) & ~unknown)
    each.unpaired = len(alone)
    if len(alone):
        yield Finding(
            "stamp",
            f"{poses.topic.name} has no pose of the stamp of "
            f"{counted(len(alone), 'message')} of {each.topic.name}, first at "
            f"{_at(each.logged[alone[0]], origin)}: see whether poses were lost, or "
            f"{each.derived.publishers[0] if each.derived else 'its node'} stamps by itself",
        )


_TITLES = ("topic", "count", "Hz", "gap s", "age ms: median", "p99", "worst", "lost", "unpaired")


def table(found: BagCheck) -> list[tuple[str, ...]]:
    """Titles and a row for each topic; ``-`` where something cannot be told.

    The age is from the stamp of a message to its publication.
    """
    rows: list[tuple[str, ...]] = [_TITLES]
    for each in found.topics:
        ages = each.ages if each.tells_latency else np.zeros(0)
        told = [f"{age:.2f}" for age in np.percentile(ages, [50, 99, 100])] if len(ages) else "---"
        interval = each.interval
        rows.append(
            (
                each.topic.name,
                str(len(each.logged)),
                f"{1e9 / interval:.1f}" if interval else "-",
                f"{each.longest_gap:.2f}" if each.longest_gap else "-",
                *told,
                "-" if each.missing is None else str(each.missing),
                "-" if each.unpaired is None else str(each.unpaired),
            )
        )
    return rows


def report(found: BagCheck) -> str:
    """The table, and a line for each finding, for a person."""
    rate = found.bytes / 1e6 / max(found.seconds, 1e-3)
    lines = [
        f"{found.bag.path}: {sum(len(each.logged) for each in found.topics)} messages, "
        f"{found.bytes / 1e6:.1f} MB, read in {found.seconds:.2f} s ({rate:.0f} MB/s)",
        "",
        *aligned(table(found)),
        "",
    ]
    lines += [
        f"{finding.kind if finding.matters else 'note'}: {finding.text}"
        for finding in found.findings
    ]
    if found.is_whole:
        lines.append("nothing is wrong with it")
    return "\n".join(printable(line) for line in lines)
