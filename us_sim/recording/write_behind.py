"""Writing a bag from a thread of its own, so that whoever has messages never waits for the disk."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from us_sim.errors import BagError, FileTakenError
from us_sim.recording.schemas import schema_text, type_hash
from us_sim.recording.topic import LOST
from us_sim.recording.writer import BagWriter


class Loss(NamedTuple):
    """Messages of one topic that were lost."""

    in_transport: int  # before they reached this process
    in_recorder: int  # since the queue or the disk was full


class Losses:
    """Counters of lost messages, for any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._in_transport: Counter[str] = Counter()
        self._in_recorder: Counter[str] = Counter()

    @property
    def total(self) -> int:
        """Messages of all topics."""
        with self._lock:
            return self._in_transport.total() + self._in_recorder.total()

    def add(self, topic: str, *, in_transport: int = 0, in_recorder: int = 0) -> None:
        """Some messages of a topic were lost."""
        with self._lock:
            self._in_transport[topic] += in_transport
            self._in_recorder[topic] += in_recorder

    def by_topic(self) -> dict[str, Loss]:
        """All that was lost so far, of topics that lost something."""
        with self._lock:
            topics = sorted({*+self._in_transport, *+self._in_recorder})
            return {t: Loss(self._in_transport[t], self._in_recorder[t]) for t in topics}


def losses_between(now: Mapping[str, Loss], before: Mapping[str, Loss]) -> dict[str, Loss]:
    """Losses between two results of `Losses.by_topic`, of topics that lost something."""
    none = Loss(0, 0)
    return {
        topic: Loss(
            loss.in_transport - before.get(topic, none).in_transport,
            loss.in_recorder - before.get(topic, none).in_recorder,
        )
        for topic, loss in now.items()
        if loss != before.get(topic)
    }


_FLUSH = 0.5  # s, after which messages are handed to the operating system
_RETRY = 1.0  # s, between checks of a disk that was full
_BATCH = 512 * 1024  # bytes of messages for which it is worth to wake the thread


class Message(NamedTuple):
    """A serialized message on its way to the file."""

    topic: str
    data: bytes
    log_time: int  # ns since the epoch, when it was received
    publish_time: int  # ns since the epoch, when it was sent
    sequence: int = 0  # counts all messages of the topic, also those that are lost


class WriteBehind:
    """A bag and the thread that writes it.

    Messages that do not fit into the queue or that the disk does not take are counted in `losses`
    and noted in the bag. When the disk was full, it is tried again every second.

    Args:
        bag: open, and used by nobody else from now on.
        max_cache_size: bytes of messages that may wait to be written; 0 makes `put` wait for the
            disk instead of losing any.
    """

    def __init__(self, bag: BagWriter, max_cache_size: int) -> None:
        self.losses = Losses()
        self.problem = ""  # why nothing is written at present
        #: Problems for whoever tells a person: ``disk`` or ``file``, and a sentence.
        self.untold: deque[tuple[str, str]] = deque(maxlen=100)
        self._bag = bag
        self._limit = max_cache_size
        self._waiting: list[Message | Callable[[], None]] = []
        self._commanded = False  # something else than messages waits
        self._bytes = 0  # of the messages that wait
        self._sequences: Counter[str] = Counter()
        self._changed = threading.Condition()
        self._ending = False
        self._noted: dict[str, Loss] = {}  # losses that the bag tells of
        self._disk_lost: Counter[str] = Counter()  # of the bag's, that are counted
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    @property
    def path(self) -> str:
        """The file that is written now."""
        return str(self._bag.path)

    def add_topic(self, topic: str, type_name: str, qos: Sequence[object] = ()) -> None:
        """Make a topic known before its first message.

        Raises:
            BagError: the type is unknown.
        """
        schema = schema_text(type_name)
        digest = type_hash(type_name)
        self._do(partial(self._bag.add_topic, topic, type_name, qos, digest, schema=schema))

    def put(self, topic: str, data: bytes, log_time: int, publish_time: int | None = None) -> bool:
        """A serialized message; False if the queue is full, and it is lost.

        Args:
            topic: added before.
            data: with its encapsulation header.
            log_time: ns since the epoch, when it was received.
            publish_time: ns since the epoch, when it was sent; the log time by default.
        """
        sent = log_time if publish_time is None else publish_time
        with self._changed:
            self._sequences[topic] += 1
            if not self._limit:
                self._changed.wait_for(lambda: self._bytes < _BATCH or self._ending)
            fits = not self._limit or self._bytes + len(data) <= self._limit
            fits = fits and not self._ending
            if fits:
                self._append(Message(topic, data, log_time, sent, self._sequences[topic]))
        if not fits:
            self.losses.add(topic, in_recorder=1)
        return fits

    def put_all(self, messages: Sequence[Message]) -> None:
        """Messages that were kept in memory until now; they always fit."""
        with self._changed:
            for message in messages:
                self._sequences[message.topic] += 1
                self._append(message._replace(sequence=self._sequences[message.topic]))

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Put a metadata record into the file."""
        self._do(partial(self._bag.note, name, values))

    def attach(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Put a file into the bag's files."""
        self._do(partial(self._bag.attach, name, media_type, data, time_ns))

    def split(self) -> None:
        """Go on in a further file."""
        self._do(self._bag.split)

    def close(self) -> None:
        """Write all waiting messages, and close the bag.

        Raises:
            BagError: as `BagWriter.close`.
        """
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._thread.join()
        if self._bag.resume():
            self.problem = ""
        try:
            self._note_losses()
            self._bag.custom_data["messages_lost"] = str(self.losses.total)
        finally:
            self._bag.close()

    def _do(self, work: Callable[[], None]) -> None:
        with self._changed:
            self._waiting.append(work)
            self._commanded = True
            self._changed.notify()

    def _append(self, message: Message) -> None:
        self._waiting.append(message)
        self._bytes += len(message.data)
        if self._bytes >= _BATCH:
            self._changed.notify()

    def _run(self) -> None:
        flush_at = time.monotonic() + _FLUSH
        while True:
            with self._changed:
                if not (self._ending or self._commanded or self._bytes >= _BATCH):
                    self._changed.wait(max(0.0, flush_at - time.monotonic()))
                batch, self._waiting, self._commanded = self._waiting, [], False
                if self._ending and not batch:
                    return
            for item in batch:
                if isinstance(item, Message):
                    self._write(item)
                else:
                    self._try(item)
            if time.monotonic() >= flush_at:
                flush_at = time.monotonic() + self._flush()

    def _write(self, message: Message) -> None:
        self._try(partial(self._bag.write, *message), message.topic)
        with self._changed:
            self._bytes -= len(message.data)
            if not self._limit:
                self._changed.notify_all()

    def _flush(self) -> float:
        """Hand everything to the operating system; s until that is to be done again."""
        if self.problem and self._bag.resume():
            self.problem = ""
        if not self.problem:
            self._try(self._note_losses)
            self._try(self._bag.flush)
        return _RETRY if self.problem else _FLUSH

    def _try(self, work: Callable[[], None], topic: str | None = None) -> None:
        """Work on the bag; a message of that topic is lost if it fails."""
        try:
            work()
        except FileTakenError as error:
            self._complain(str(error), "file")
        except BagError as error:
            self._complain(str(error))
        except Exception as error:  # nothing may end the thread, and nothing be lost unsaid
            self._complain(f"a message on {topic} cannot be written: {error!r}")
            if topic is not None:
                self.losses.add(topic, in_recorder=1)
        if self._bag.lost != self._disk_lost:
            for name, count in (self._bag.lost - self._disk_lost).items():
                self.losses.add(name, in_recorder=count)
            self._disk_lost = self._bag.lost.copy()

    def _complain(self, problem: str, kind: str = "disk") -> None:
        if problem != self.problem:
            self.problem = problem
            self.untold.append((kind, problem))

    def _note_losses(self) -> None:
        """Note the losses since the last note."""
        lost = self.losses.by_topic()
        if lost != self._noted and not self.problem:
            new = losses_between(lost, self._noted)
            self._bag.note(LOST, {topic: str(sum(loss)) for topic, loss in new.items()})
            self._noted = lost


class PreRoll:
    """A ring of messages, as rosbag2's snapshot mode keeps it.

    Of a latched topic the newest message is kept whatever its age: a late listener would get it,
    and the recording makes no sense without it. Of others the oldest go, where there are more than
    ``max_bytes``, or they are older than the newest by more than ``duration`` s (0 for any).
    """

    def __init__(self, max_bytes: int, duration: float = 0.0) -> None:
        self._max_bytes, self._duration = max_bytes, round(duration * 1e9)
        self._ring: deque[Message] = deque()
        self._bytes = 0
        self._latched: dict[str, Message] = {}

    def add(self, message: Message, *, latched: bool = False) -> None:
        """Keep a message, and drop those that are too old or too many."""
        if latched:
            before = self._latched.get(message.topic)
            self._latched[message.topic] = message
            if before is None:
                return
            message = before
        self._ring.append(message)
        self._bytes += len(message.data)
        oldest = message.log_time - self._duration if self._duration else 0
        while self._ring and (self._bytes > self._max_bytes or self._ring[0].log_time < oldest):
            self._bytes -= len(self._ring.popleft().data)

    def take(self) -> list[Message]:
        """The kept messages by their times; none are kept afterwards."""
        messages = sorted([*self._latched.values(), *self._ring], key=lambda each: each.log_time)
        self._ring.clear()
        self._latched.clear()
        self._bytes = 0
        return messages
