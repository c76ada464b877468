"""Writing a bag from a thread of its own, so that whoever has messages never waits for the disk."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from us_sim.errors import BagError
from us_sim.recording.schemas import schema_text, type_hash
from us_sim.recording.topic import LOST
from us_sim.recording.writer import BagWriter

_FLUSH = 0.5  # s, after which messages are handed to the operating system
_PAUSE = 0.05  # s, in which messages gather: to be woken for each costs whoever has them time
_RETRY = 1.0  # s, between tries to write to a disk that was full
_BATCH = 512 * 1024  # bytes that may wait where `put` waits for the disk


class Message(NamedTuple):
    """A serialized message on its way to the file."""

    topic: str
    data: bytes
    log_time: int  # ns since the epoch, when it was received
    publish_time: int  # ns since the epoch, when it was sent
    sequence: int = 0  # counts all messages of the topic, also those that are lost


class WriteBehind:
    """A bag and the thread that writes it.

    While the disk is full, messages wait in the queue, and the disk is tried again every second.
    Those that do not fit into the queue are counted in `losses` and noted in the bag.

    Args:
        bag: open, and used by nobody else from now on.
        max_cache_size: bytes of messages that may wait to be written; 0 makes `put` wait for the
            disk instead of losing any, unless the disk is full.
    """

    def __init__(self, bag: BagWriter, max_cache_size: int) -> None:
        self.problem = ""  # why nothing is written at present
        self.untold: deque[str] = deque(maxlen=100)  # sentences, for whoever tells a person
        self._bag = bag
        self._limit = max_cache_size
        self._queue: queue.Queue[Message | Callable[[], None] | None] = queue.Queue()
        self._put, self._written = 0, 0  # bytes of messages
        self._sequences: Counter[str] = Counter()
        self._lost: Counter[str] = Counter()
        self._lock = threading.Lock()  # of `_lost`
        self._noted: Counter[str] = Counter()  # losses that the bag tells of
        self._ending = threading.Event()
        self._has_given_up = False
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    @property
    def path(self) -> str:
        """The first file that is written."""
        return str(self._bag.path)

    @property
    def losses(self) -> Counter[str]:
        """Messages that were lost so far, by topic."""
        with self._lock:
            return self._lost.copy()

    def lose(self, topic: str, count: int) -> None:
        """Count messages that were lost, before they came here or since."""
        with self._lock:
            self._lost[topic] += count

    def add_topic(self, topic: str, type_name: str, qos: Sequence[object] = ()) -> None:
        """Make a topic known before its first message.

        Raises:
            BagError: the type is unknown.
        """
        schema = schema_text(type_name)
        digest = type_hash(type_name)
        self._queue.put(partial(self._bag.add_topic, topic, type_name, qos, digest, schema=schema))

    def put(self, topic: str, data: bytes, log_time: int, publish_time: int | None = None) -> bool:
        """A serialized message; False if the queue is full, and it is lost.

        Args:
            topic: added before.
            data: with its encapsulation header.
            log_time: ns since the epoch, when it was received.
            publish_time: ns since the epoch, when it was sent; the log time by default.
        """
        while not self._limit and self._put - self._written >= _BATCH and not self.problem:
            time.sleep(0.001)
        self._sequences[topic] += 1
        fits = self._put - self._written + len(data) <= (self._limit or _BATCH + len(data))
        if fits:
            sent = log_time if publish_time is None else publish_time
            self._append(Message(topic, data, log_time, sent, self._sequences[topic]))
        else:
            self.lose(topic, 1)
        return fits

    def put_all(self, messages: Sequence[Message]) -> None:
        """Messages that were kept in memory until now; they always fit."""
        for message in messages:
            self._sequences[message.topic] += 1
            self._append(message._replace(sequence=self._sequences[message.topic]))

    def note(self, name: str, values: Mapping[str, str]) -> None:
        """Put a metadata record into the file."""
        self._queue.put(partial(self._bag.note, name, values))

    def attach(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Put a file into the bag's files."""
        self._queue.put(partial(self._bag.attach, name, media_type, data, time_ns))

    def split(self) -> None:
        """Go on in a further file."""
        self._queue.put(self._bag.split)

    def close(self) -> None:
        """Write all waiting messages, and close the bag.

        Raises:
            BagError: as `BagWriter.close`.
        """
        self._ending.set()
        self._queue.put(None)
        self._thread.join()
        self._try(self._note_losses)
        self._bag.custom_data["messages_lost"] = str(self.losses.total())
        try:
            self._bag.close()
        finally:
            self._take_losses()

    def _append(self, message: Message) -> None:
        self._put += len(message.data)
        self._queue.put(message)

    def _run(self) -> None:
        flush_at = time.monotonic() + _FLUSH
        while True:
            if self._limit and self._queue.empty():
                self._ending.wait(_PAUSE)
            try:
                item = self._queue.get(timeout=max(0.0, flush_at - time.monotonic()))
                if item is None:
                    return
                self._await_room()
                if isinstance(item, Message):
                    self._write(item)
                else:
                    self._try(item)
            except queue.Empty:
                pass
            if time.monotonic() >= flush_at:
                self._try(self._note_losses)
                self._try(self._bag.flush)
                flush_at = time.monotonic() + _FLUSH

    def _await_room(self) -> None:
        while self._bag.problem and not self._has_given_up:
            self._has_given_up = self._ending.wait(_RETRY)  # after one more try
            self._try(self._bag.flush)

    def _write(self, message: Message) -> None:
        if self._bag.problem or not self._try(partial(self._bag.write, *message)):
            self.lose(message.topic, 1)
        self._written += len(message.data)

    def _try(self, work: Callable[[], None]) -> bool:
        """Work on the bag; whether nothing failed. Whatever does neither ends the thread."""
        failure = ""
        try:
            work()
        except BagError as error:
            failure = str(error)
        except Exception as error:
            failure = f"{self.path} cannot be written: {error!r}"
        told = failure or self._bag.problem
        if told and told != self.problem:
            self.untold.append(told)
        self.problem = self._bag.problem
        self._take_losses()
        return not failure

    def _take_losses(self) -> None:
        lost, self._bag.lost = self._bag.lost, Counter()
        for topic, count in lost.items():
            self.lose(topic, count)

    def _note_losses(self) -> None:
        """Note the losses since the last note."""
        lost = self.losses
        if lost != self._noted and not self._bag.problem:
            new = lost - self._noted
            self._noted = lost
            self._bag.note(LOST, {topic: str(count) for topic, count in new.items()})


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
