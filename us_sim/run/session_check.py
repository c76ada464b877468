"""Whether a recording can be trusted: its index, order, gaps, latency, losses, and unpaired stamps.

Nothing is decoded but the stamps, so that the time goes into reading the file.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.errors import printable
from us_sim.nodes.settings import AnnotatedImageSettings
from us_sim.nodes.topics import TOPICS
from us_sim.recording.reader import Bag
from us_sim.recording.stamps import stamp_reader
from us_sim.recording.topic import BagTopic, Fault
from us_sim.run.session_tables import SECOND, Progress, read_times
from us_sim.settings.spelling import aligned, counted

POSES = "probe/pose"
DERIVED = [
    topic.name
    for topic in TOPICS
    if {*topic.publishers} <= {"tissue_deformer", "skin_deformer", "slice_interpolator"}
    and topic.publishers
    and not (topic.latched or topic.on_demand)
]
"""Topics whose messages carry the stamp of the pose that they follow from."""

STALE = AnnotatedImageSettings().stale_after
"""s without a message after which there is a gap: an image is called stale then."""
TITLES = ("topic", "count", "Hz", "gap s", "age ms: median", "p99", "worst", "lost", "unpaired")
"""Of the printed columns; the age is from the stamp of a message to its publication."""
_PERIODS = 5  # of a topic, that a gap has at least
_REGULAR = 20  # messages of a topic, from which on its rate is known
_APART = 1e-3  # s, by which two clocks may differ unnoticed
_OTHER_TIME = 60.0  # s, by which times differ that are not of the same clock or recording
_SHARED = ("tf2_msgs/msg/TFMessage", "diagnostic_msgs/msg/DiagnosticArray")
"""Types of topics that many publish at once, each later than it stamps, and heard in any order."""
_SHARED_DELAY = 10 * SECOND  # ns, by which their stamps may go back: a busy machine delays one
_SEVERAL = 0.01  # of the numbers of a topic, that go back where several publishers count
_CLOCKS = "let the machines' clocks follow one of them (chrony, or NTP)"


class Finding(NamedTuple):
    """Something that is not as it should be."""

    kind: str  # index, order, gap, latency, loss or stamp
    text: str  # a sentence: what, where, what to do
    matters: bool = True  # else it is only good to know


@dataclass
class TopicCheck:
    """One topic's messages, and what is found on them."""

    topic: BagTopic
    messages: pd.DataFrame  # as of `read_times`
    has_stamps: bool
    start: int  # ns, of the recording
    is_cut: bool  # whether the recording ends before its time
    poses: pd.DataFrame | None  # that the messages follow from, if they follow from any
    findings: list[Finding] = field(default_factory=list)
    interval: float | None = None  # s from message to message as is usual, where there is such
    longest_gap: float | None = None  # s
    ages: pd.Series | None = None  # s from stamp to sending, where that is a latency
    missing: int | None = None  # messages, by their numbers; None without numbers
    unpaired: int | None = None  # messages; None where no pose is followed

    def tell(self, kind: str, text: str) -> None:
        """Add a finding on the topic."""
        self.findings.append(Finding(kind, f"{self.topic.name} {text}"))

    def tell_rows(self, kind: str, rows: pd.Series, text: str, remedy: str) -> None:
        """Add a finding on the messages for which ``rows`` holds, if there are any."""
        if rows.any():
            logged = self.messages["logged"][rows.idxmax()]
            first = f"first at {(logged - self.start) / SECOND:.3f} s"
            count = counted(int(rows.sum()), "message")
            self.tell(kind, f"has {count} that {text}, {first}: {remedy}")

    def check_order(self) -> None:
        """Find stamps that go back, or are all 0, and messages that are too short for one."""
        is_short = self.messages["is_short"] > 0
        text = f"came too short for {self.topic.type_name}"
        self.tell_rows("order", is_short, text, "find out what publishes them")
        stamps = self.messages["stamp"].where(lambda stamp: stamp != 0).ffill()
        if not self.has_stamps or self.topic.is_latched or stamps.empty:
            return
        if stamps.isna().all():
            self.tell("order", "has stamps that are all 0: let its publisher stamp what it sends")
        may_go_back = _SHARED_DELAY if self.topic.type_name in _SHARED else 0
        remedy = "let one node publish it, with one clock"
        back = stamps.diff() < -may_go_back
        self.tell_rows("order", back, "went back in their stamps", remedy)

    def check_numbers(self, said: int, *, one_counter: bool) -> None:
        """Find missing messages, and numbers that go back.

        Args:
            said: messages that the recorder says it lost.
            one_counter: whether the numbers are those of all topics together.
        """
        numbers = self.messages["number"]
        steps = numbers.diff()
        restarts = (steps < 0) & (numbers <= 1) & (numbers.iloc[:1].min() <= 1)
        back = (steps <= 0) & ~restarts
        if numbers.any() and not one_counter and back.sum() <= max(_SEVERAL * len(numbers), 1):
            parts = numbers.groupby(restarts.cumsum())
            self.missing = int((parts.max() - parts.min() + 1 - parts.nunique()).sum())
            if self.topic.type_name not in _SHARED:
                why = "they were exchanged or doubled, or the recorder's clock was set back"
                self.tell_rows("order", back, "went back in their numbers", why)
        if lost := self.missing or said:
            where = f", as the recorder counted {said}" if said else ""
            jumps = self.messages["logged"].shift()[steps > 1]
            if self.missing and len(jumps):
                where += f", the first after {(jumps.iloc[0] - self.start) / SECOND:.3f} s"
            self.tell(
                "loss",
                f"lacks {counted(lost, 'message')}{where}: give session_recorder a larger "
                f"max_cache_size, and its publisher a depth for a second",
            )

    def check_gaps(self) -> None:
        """Find times without messages: of a regular topic, or while poses came."""
        times = self._times(self.messages)
        steps = np.diff(times)
        if len(times) >= _REGULAR and not self.topic.is_latched:
            usual, long = np.percentile(steps, [50, 90]).tolist()
            self.interval = usual if 0 < long <= 2 * usual else None
        if self.poses is not None:
            # What follows from poses is missed where poses came, and at the end, too.
            came = self._times(self.poses)
            begins = times if len(times) else came[:1]
            ends = np.append(begins[1:], begins[-1] if self.is_cut else max(came[-1], begins[-1]))
            steps = ends - begins
            between = np.searchsorted(came, ends) - np.searchsorted(came, begins, "right")
            is_gap = (steps > STALE) & (between > 1)
            why = "while poses came: see its node's diagnostics and log, whether it ended"
        elif self.interval:
            begins, is_gap = times, steps > max(STALE, _PERIODS * self.interval)
            rate = f"where {1 / self.interval:.1f} Hz are usual"
            why = f"{rate}: see whether its publisher or the recording stood still"
        else:
            return
        self.longest_gap = float(steps.max())
        if is_gap.any():
            worst = int(np.argmax(np.where(is_gap, steps, 0.0)))
            count = counted(int(is_gap.sum()), "gap")
            longest = f"the longest of {steps[worst]:.3f} s at {begins[worst]:.3f} s"
            self.tell("gap", f"has {count}, {longest}, {why}")

    def _times(self, messages: pd.DataFrame) -> NDArray[np.float64]:
        """When messages were sent, s since the start; or recorded, if another clock sent them."""
        sent, logged = messages["sent"], messages["logged"]
        times = sent.where((logged - sent).abs() < _OTHER_TIME * SECOND, logged)
        return np.sort((times - self.start) / SECOND)

    def check_latency(self) -> None:
        """Find messages that came before they were sent, or long after their stamp."""
        stamp, sent, logged = (self.messages[name] for name in ("stamp", "sent", "logged"))
        ages = ((sent - stamp) / SECOND).where(stamp != 0)
        delays = (logged - sent) / SECOND
        if max(abs(ages.median()), abs(delays.median())) > _OTHER_TIME:
            text = (
                f"{self.topic.name} was stamped, sent and recorded by clocks over a minute apart, "
                f"as in lockstep, under simulated time or when played: no latency is told"
            )
            self.findings.append(Finding("latency", text, matters=False))
            return
        most = f"came up to {-1e3 * delays.min():.1f} ms before being sent"
        self.tell_rows("latency", delays < -_APART, most, _CLOCKS)
        if not self.has_stamps or self.topic.is_latched or not stamp.any():
            return
        self.ages = ages.dropna()
        most = f"bore stamps up to {-1e3 * ages.min():.1f} ms after their sending"
        self.tell_rows("latency", ages < -_APART, most, _CLOCKS)
        if self.poses is not None:
            text = f"followed from poses more than {STALE:.1f} s old"
            remedy = "give its node more processor time, or a coarser scene"
            self.tell_rows("latency", ages > STALE, text, remedy)

    def check_pairs(self) -> None:
        """Find messages without their pose.

        Nobody knows those before the first recorded one, and after the last where the bag was cut.
        """
        if self.poses is None:
            return
        stamps, known = self.messages["stamp"], self.poses["stamp"]
        unknown = (stamps < known.min()) & (stamps > known.min() - SECOND)
        alone = ~stamps.isin(known) & ~unknown & ~(self.is_cut & (stamps > known.max()))
        self.unpaired = int(alone.sum())
        text = f"came without the {POSES} of their stamp"
        remedy = "see whether poses were lost, or its node stamps by itself"
        self.tell_rows("stamp", alone, text, remedy)

    @property
    def row(self) -> tuple[str, ...]:
        """The numbers below `TITLES`; ``-`` where something cannot be told."""
        ages = [None] * 3 if self.ages is None else np.percentile(1e3 * self.ages, [50, 99, 100])
        told = [self.longest_gap or None, *ages]
        return (
            self.topic.name,
            str(len(self.messages)),
            f"{1 / self.interval:.1f}" if self.interval else "-",
            *("-" if number is None else f"{number:.2f}" for number in told),
            *("-" if count is None else str(count) for count in (self.missing, self.unpaired)),
        )


@dataclass(frozen=True)
class BagCheck:
    """The findings on a bag."""

    bag: Bag
    topics: list[TopicCheck]  # by name
    findings: list[Finding]
    seconds: float  # that reading took

    @property
    def is_whole(self) -> bool:
        """Whether nothing was found that matters."""
        return not any(finding.matters for finding in self.findings)

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Titles, and the numbers of each topic."""
        return [TITLES, *(each.row for each in self.topics)]


def check(bag: Bag, progress: Progress = lambda *_: None) -> BagCheck:
    """Read all of a bag and judge it.

    Args:
        bag: of a session or of anything else.
        progress: takes the fraction done, and what is being read.
    """
    began = time.monotonic()
    faults: list[Fault] = []
    tables = read_times(bag, None, faults, progress)
    start, is_cut, lost = bag.start or 0, bool(bag.opening_faults), bag.lost()
    heard = [table["number"] for table in tables.values() if len(table)]
    one_counter = len(heard) > 1 and pd.concat(heard).is_unique
    findings, topics = [*_check_index(bag, faults)], list[TopicCheck]()
    for topic in sorted(bag.topics, key=lambda topic: topic.name):
        derived = next((name for name in DERIVED if topic.name.endswith(f"/{name}")), None)
        poses = tables.get(f"{topic.name.removesuffix(derived)}{POSES}") if derived else None
        followed = poses if poses is not None and len(poses) else None
        has_stamps = stamp_reader(bag, topic) is not None
        each = TopicCheck(topic, tables[topic.name], has_stamps, start, is_cut, followed)
        each.check_order()
        each.check_numbers(lost[topic.name], one_counter=one_counter)
        each.check_gaps()
        each.check_latency()
        each.check_pairs()
        topics.append(each)
        findings += each.findings
    damaged = sum(fault.messages for fault in faults)
    if damaged > 0 and sum(each.missing or 0 for each in topics) <= damaged:
        # The damaged parts held what is missing, and the poses of these stamps.
        findings = [finding for finding in findings if finding.kind not in ("loss", "stamp")]
    return BagCheck(bag, topics, findings, time.monotonic() - began)


def _check_index(bag: Bag, faults: list[Fault]) -> Iterator[Finding]:
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
    if not bag.message_count:
        yield Finding("index", f"{bag.path} holds no message: record again")


def report(found: BagCheck) -> str:
    """The table, and a line for each finding, for a person."""
    count = sum(len(each.messages) for each in found.topics)
    size = sum(int(each.messages["size"].sum()) for each in found.topics) / 1e6
    speed = f"{found.seconds:.2f} s ({size / max(found.seconds, 1e-3):.0f} MB/s)"
    head = f"{found.bag.path}: {count} messages, {size:.1f} MB, read in {speed}"
    told = [f"{each.kind if each.matters else 'note'}: {each.text}" for each in found.findings]
    whole = ["nothing is wrong with it"] if found.is_whole else []
    lines = [head, "", *aligned(found.rows), "", *told, *whole]
    return "\n".join(printable(line) for line in lines)
