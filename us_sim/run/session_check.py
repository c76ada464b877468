"""Faults of a recording: of its index, order, gaps, latency, losses, and unpaired stamps.

Nothing is decoded but the stamps, so that the time goes into reading the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.nodes.settings import AnnotatedImageSettings
from us_sim.nodes.topics import TOPICS
from us_sim.recording.decoding import SECOND
from us_sim.recording.reader import Bag
from us_sim.recording.topic import BagTopic
from us_sim.run.session_tables import read_times
from us_sim.settings.spelling import format_count

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


@dataclass(frozen=True)
class BagCheck:
    """The findings on a bag."""

    bag: Bag
    topics: list[TopicCheck]  # by name
    findings: list[Finding]

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """List the titles, and the numbers of each topic; ``-`` where one cannot be told."""
        return [TITLES, *(each.row for each in self.topics)]


class TopicCheck:
    """The messages of one topic, as of `read_times`, and the findings on them.

    They may follow from poses, and be numbered by themselves.
    """

    def __init__(
        self,
        bag: Bag,
        topic: BagTopic,
        messages: pd.DataFrame,
        poses: pd.DataFrame | None,
        is_numbered: bool,
    ) -> None:
        self.topic, self.messages, self._poses = topic, messages, poses
        self._start, self._is_cut = bag.start or 0, bool(bag.fault)
        self._is_timed = bag.make_stamp_reader(topic) is not None and not topic.is_latched
        self.findings: list[Finding] = []
        self.missing = self._check_numbers(bag.count_losses()[topic.name], is_numbered)
        self._check_order()
        rate, gap = self._check_gaps()
        ages = self._check_latency()
        numbers = [gap, *(np.percentile(1e3 * ages, [50, 99, 100]) if len(ages) else [None] * 3)]
        self.row = (
            topic.name,
            str(len(messages)),
            f"{rate:.1f}" if rate else "-",
            *("-" if number is None else f"{number:.2f}" for number in numbers),
            *("-" if n is None else str(n) for n in (self.missing, self._check_pairs())),
        )

    def _tell(self, kind: str, text: str) -> None:
        self.findings.append(Finding(kind, f"{self.topic.name} {text}"))

    def _tell_rows(self, kind: str, rows: pd.Series, text: str, remedy: str) -> None:
        """Add a finding on the messages for which ``rows`` holds, if there are any."""
        if rows.any():
            first = (self.messages["logged"][rows.idxmax()] - self._start) / SECOND
            count = format_count(int(rows.sum()), "message")
            self._tell(kind, f"has {count} that {text}, first at {first:.3f} s: {remedy}")

    def _check_numbers(self, said: int, is_numbered: bool) -> int | None:
        """Find missing messages, by their numbers or as the recorder says; return their number."""
        numbers, missing = self.messages["number"], None
        restarts = (numbers.diff() < 0) & (numbers <= 1) & (numbers.iloc[:1].min() <= 1)
        back = (numbers.diff() <= 0) & ~restarts
        if is_numbered and numbers.any() and back.sum() <= max(_SEVERAL * len(numbers), 1):
            parts = numbers.groupby(restarts.cumsum())
            missing = int((parts.max() - parts.min() + 1 - parts.nunique()).sum())
            if self.topic.type_name not in _SHARED:
                why = "they were exchanged or doubled, or the recorder's clock was set back"
                self._tell_rows("order", back, "went back in their numbers", why)
        if lost := missing or said:
            where = f", as the recorder counted {said}" if said else ""
            remedy = "a larger max_cache_size, and its publisher a depth for a second"
            count = format_count(lost, "message")
            self._tell("loss", f"lacks {count}{where}: give session_recorder {remedy}")
        return missing

    def _check_order(self) -> None:
        """Find stamps that go back, or are all 0, and messages that are too short for one."""
        is_short = self.messages["is_short"] > 0
        text = f"came too short for {self.topic.type_name}"
        self._tell_rows("order", is_short, text, "find out what publishes them")
        stamps = self.messages["stamp"].where(lambda stamp: stamp != 0).ffill()
        if not self._is_timed or stamps.empty:
            return
        if stamps.isna().all():
            self._tell("order", "has stamps that are all 0: let its publisher stamp what it sends")
        back = stamps.diff() < -_SHARED_DELAY * (self.topic.type_name in _SHARED)
        remedy = "let one node publish it, with one clock"
        self._tell_rows("order", back, "went back in their stamps", remedy)

    def _check_gaps(self) -> tuple[float | None, float | None]:
        """Find times without messages: of a regular topic, or while poses came.

        Returns:
            The rate in Hz, where there is one, and the longest gap in s.
        """
        times, interval = self._times(self.messages), 0.0
        if len(times) >= _REGULAR and not self.topic.is_latched:
            usual, long = np.percentile(np.diff(times), [50, 90])
            interval = usual if 0 < long <= 2 * usual else 0.0
        rate = 1 / interval if interval else None
        if self._poses is not None:
            # What follows from poses is missed where poses came, and at the end, too.
            came = self._times(self._poses)
            begins = times if len(times) else came[:1]
            ends = np.append(begins[1:], begins[-1] if self._is_cut else max(came[-1], begins[-1]))
            between = np.searchsorted(came, ends) - np.searchsorted(came, begins, "right")
            is_gap = (ends - begins > STALE) & (between > 1)
            why = "while poses came: see its node's diagnostics and log, whether it ended"
        elif rate:
            begins, ends = times[:-1], times[1:]
            is_gap = ends - begins > max(STALE, _PERIODS * interval)
            usual = f"where {rate:.1f} Hz are usual"
            why = f"{usual}: see whether its publisher or the recording stood still"
        else:
            return rate, None
        steps = ends - begins
        if is_gap.any():
            worst = int(np.argmax(np.where(is_gap, steps, 0.0)))
            longest = f"the longest of {steps[worst]:.3f} s at {begins[worst]:.3f} s"
            self._tell("gap", f"has {format_count(int(is_gap.sum()), 'gap')}, {longest}, {why}")
        return rate, float(steps.max()) or None

    def _times(self, messages: pd.DataFrame) -> NDArray[np.float64]:
        """Tell when messages were sent, s since the start; or recorded, if by another clock."""
        sent, logged = messages["sent"], messages["logged"]
        times = sent.where((logged - sent).abs() < _OTHER_TIME * SECOND, logged)
        return np.sort((times - self._start) / SECOND)

    def _check_latency(self) -> pd.Series:
        """Find messages that came before they were sent, or long after their stamp.

        Returns:
            s from stamp to sending, where that is a latency.
        """
        stamp, sent, logged = (self.messages[name] for name in ("stamp", "sent", "logged"))
        ages = ((sent - stamp) / SECOND).where(stamp != 0)
        delays = (logged - sent) / SECOND
        if max(abs(ages.median()), abs(delays.median())) > _OTHER_TIME:
            return ages[:0]  # as in lockstep, under simulated time or when played
        most = f"came up to {-1e3 * delays.min():.1f} ms before being sent"
        self._tell_rows("latency", delays < -_APART, most, _CLOCKS)
        if not self._is_timed:
            return ages[:0]
        most = f"bore stamps up to {-1e3 * ages.min():.1f} ms after their sending"
        self._tell_rows("latency", ages < -_APART, most, _CLOCKS)
        if self._poses is not None:
            text = f"followed from poses more than {STALE:.1f} s old"
            remedy = "give its node more processor time, or a coarser scene"
            self._tell_rows("latency", ages > STALE, text, remedy)
        return ages.dropna()

    def _check_pairs(self) -> int | None:
        """Find messages without their pose; return their number.

        Nobody knows those before the first recorded one, and after the last where the bag was cut.
        """
        if self._poses is None:
            return None
        stamps, known = self.messages["stamp"], self._poses["stamp"]
        unknown = (stamps < known.min()) & (stamps > known.min() - SECOND)
        alone = ~stamps.isin(known) & ~unknown & ~(self._is_cut & (stamps > known.max()))
        remedy = "see whether poses were lost, or its node stamps by itself"
        self._tell_rows("stamp", alone, f"came without the {POSES} of their stamp", remedy)
        return int(alone.sum())


def check_bag(bag: Bag, progress: Progress = lambda *_: None) -> BagCheck:
    """Read all of a bag, of a session or of anything else, and judge it."""
    faults: list[str] = []
    tables = read_times(bag, None, faults, progress)
    heard = {name: table for name, table in tables.items() if len(table)}
    is_numbered = len(heard) < 2 or not pd.concat(heard)["number"].is_unique  # not all together
    topics: list[TopicCheck] = []
    for topic in sorted(bag.topics, key=lambda topic: topic.name):
        derived = next((name for name in DERIVED if topic.name.endswith(f"/{name}")), None)
        poses = heard.get(f"{topic.name.removesuffix(derived)}{POSES}") if derived else None
        topics.append(TopicCheck(bag, topic, tables[topic.name], poses, is_numbered))
    findings = [finding for each in topics for finding in each.findings]
    if faults:
        # The damaged parts may have held what is missing, and the poses of these stamps.
        findings = [finding for finding in findings if finding.kind not in ("loss", "stamp")]
    if not bag.message_count:
        faults.append(f"{bag.path} holds no message: record again")
    return BagCheck(bag, topics, [*(Finding("index", text) for text in faults), *findings])
