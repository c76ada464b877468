"""Writing a bag from a thread of its own, so that whoever has messages never waits for the disk."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from functools import partial

from rosbags.interfaces import Qos

from us_sim.errors import BagError
from us_sim.recording.schemas import compute_type_hash, make_schema
from us_sim.recording.topic import LOST
from us_sim.recording.writer import BagWriter

_FLUSH = 0.2  # s, after which messages are handed to the operating system
_PAUSE = 0.05  # s, in which messages gather: to be woken for each costs whoever has them time
_RETRY = 1.0  # s, between tries to write to a disk that was full
_BATCH = 512 * 1024  # bytes that may wait where `put_message` waits for the disk


class WriteBehind:
    """A bag and the thread that writes it.

    While the disk is full, messages wait in the queue, and the disk is tried again every second.
    Those that do not fit into the queue are counted in `losses`, and noted in the bag at its end.

    Args:
        bag: open, and used by nobody else from now on.
        max_cache_size: bytes of messages that may wait to be written; 0 makes `put_message` wait
            for the disk instead of losing any, unless the disk is full.
    """

    def __init__(self, bag: BagWriter, max_cache_size: int) -> None:
        self.untold: deque[str] = deque(maxlen=100)  # sentences, for whoever tells a person
        self._bag = bag
        self._limit = max_cache_size
        self._queue: queue.Queue[Callable[[], None] | None] = queue.Queue()
        self._put, self._written = 0, 0  # bytes of messages
        self._sequences: Counter[str] = Counter()  # all messages of a topic, also the lost ones
        self._lost: Counter[str] = Counter()
        self._lock = threading.Lock()  # of `_lost`
        self._told = ""  # the sentence that was told last
        self._ending = threading.Event()
        self._has_given_up = False
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    @property
    def problem(self) -> str:
        """Say why nothing is written at present; empty when something is."""
        return self._bag.problem

    @property
    def losses(self) -> Counter[str]:
        """Return the messages that were lost so far, by topic."""
        with self._lock:
            return self._lost.copy()

    def count_lost(self, topic: str, count: int) -> None:
        """Count messages that were lost, before they came here or since."""
        with self._lock:
            self._lost[topic] += count

    def add_topic(self, topic: str, type_name: str, qos: Iterable[Qos] = ()) -> None:
        """Make a topic known before its first message.

        Raises:
            BagError: the type is unknown.
        """
        schema, digest = make_schema(type_name), compute_type_hash(type_name)
        self._queue.put(partial(self._bag.add_topic, topic, type_name, qos, digest, schema=schema))

    def put_message(
        self, topic: str, data: bytes, log_time: int, publish_time: int | None = None
    ) -> bool:
        """Have a serialized message written; False if the queue is full, and it is lost.

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
            self._put += len(data)
            given = topic, data, log_time, publish_time, self._sequences[topic]
            self._queue.put(partial(self._write, *given))
        else:
            self.count_lost(topic, 1)
        return fits

    def attach_file(self, name: str, media_type: str, data: bytes, time_ns: int) -> None:
        """Put a file into the bag."""
        self._queue.put(partial(self._bag.attach_file, name, media_type, data, time_ns))

    def close(self) -> None:
        """Write all waiting messages, and close the bag.

        Raises:
            BagError: as `BagWriter.close`.
        """
        self._ending.set()
        self._queue.put(None)
        self._thread.join()
        if lost := self.losses:
            note = {topic: str(count) for topic, count in lost.items()}
            self._try(partial(self._bag.write_metadata, LOST, note))
        self._bag.close()

    def _run(self) -> None:
        flush_at = time.monotonic() + _FLUSH
        while True:
            if self._limit and self._queue.empty():
                self._ending.wait(_PAUSE)
            try:
                work = self._queue.get(timeout=max(0.0, flush_at - time.monotonic()))
                if work is None:
                    return
                while self._bag.problem and not self._has_given_up:
                    self._has_given_up = self._ending.wait(_RETRY)  # after one more try
                    self._try(self._bag.flush)
                self._try(work)
            except queue.Empty:
                pass
            if time.monotonic() >= flush_at:
                self._try(self._bag.flush)
                flush_at = time.monotonic() + _FLUSH

    def _write(self, topic: str, data: bytes, log: int, publish: int | None, number: int) -> None:
        self._written += len(data)
        try:
            if self._bag.problem:
                raise BagError(self._bag.problem)
            self._bag.write_message(topic, data, log, publish, number)
        except Exception:
            self.count_lost(topic, 1)
            raise

    def _try(self, work: Callable[[], None]) -> None:
        """Work on the bag; a failure of any kind is told, and does not end the thread."""
        failure = ""
        try:
            work()
        except BagError as error:
            failure = str(error)
        except Exception as error:
            failure = f"{self._bag.path} cannot be written: {error!r}"
        told = failure or self.problem
        if told and told != self._told:
            self.untold.append(told)
        self._told = told
