"""Executors: they wait until something is ready and run its callback.

Waiting costs nothing: data, triggers, shutdown and the like wake the waiting thread.
"""

import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from operator import attrgetter
from typing import Any

from .context import Context, WakeUp, get_default_context
from .exceptions import InvalidHandle
from .node import Node
from .task import Future
from .time import S_TO_NS


class RunningCallbacks:
    """Counts the callbacks that run, by thread."""

    def __init__(self) -> None:
        self._threads: dict[int, int] = {}
        self._changed = threading.Condition()

    def begin(self) -> None:
        me = threading.get_ident()
        with self._changed:
            self._threads[me] = self._threads.get(me, 0) + 1

    def end(self) -> None:
        me = threading.get_ident()
        with self._changed:
            self._threads[me] -= 1
            if not self._threads[me]:
                del self._threads[me]
            self._changed.notify_all()

    def wait(self, timeout_sec: float | None) -> bool:
        """Wait until no other thread runs a callback; False when it takes longer."""
        me = threading.get_ident()
        if timeout_sec is not None and timeout_sec < 0:
            timeout_sec = None
        with self._changed:
            return self._changed.wait_for(lambda: not self._threads.keys() - {me}, timeout_sec)


class ExternalShutdownException(Exception):
    """The context was shut down."""


class Executor(AbstractContextManager["Executor"]):
    """Base of SingleThreadedExecutor and MultiThreadedExecutor."""

    _runs_elsewhere = False  # callbacks run in other threads than the one that waits
    context = property(attrgetter("_context"))

    def __init__(self, *, context: Context | None = None) -> None:
        self._context = get_default_context() if context is None else context
        self._context._require_init("executor")
        self._nodes: dict[Node, None] = {}
        self._nodes_lock = threading.RLock()
        self._wake_up = WakeUp()
        self._context._register(self._wake_up)
        self._is_shutdown = False
        self._running = RunningCallbacks()
        self._round: Iterator[Any] = iter(())

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Start no more callbacks, and wait for those that run; False when that takes longer."""
        self._is_shutdown = True
        self.wake()
        if not self._running.wait(timeout_sec):
            return False
        with self._nodes_lock:
            self._nodes = {}
        self._round = iter(())
        return True

    def add_node(self, node: Node) -> bool:
        with self._nodes_lock:
            if node in self._nodes:
                return False
            self._nodes[node] = None
            node.executor = self
        self.wake()
        return True

    def remove_node(self, node: Node) -> None:
        with self._nodes_lock:
            if node in self._nodes:
                del self._nodes[node]
                self.wake()

    def wake(self) -> None:
        """Have the waiting thread look at everything anew."""
        self._wake_up.wake()

    def get_nodes(self) -> list[Node]:
        with self._nodes_lock:
            return list(self._nodes)

    def spin(self) -> None:
        while self._context.ok() and not self._is_shutdown:
            self.spin_once()

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run callbacks until a future is done, or the time is over."""
        timeout = None if timeout_sec is None or timeout_sec < 0 else timeout_sec
        deadline = None if timeout is None else time.monotonic() + timeout
        with self._woken_by(future):
            while self._context.ok() and not future.done() and not self._is_shutdown:
                self._spin_once(timeout, future.done)
                if deadline is not None:
                    timeout = deadline - time.monotonic()
                    if timeout <= 0:
                        return

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback, waiting for one to be ready until the time is over."""
        self._spin_once(timeout_sec, lambda: False)

    def spin_once_until_future_complete(
        self, future: Future, timeout_sec: float | None = None
    ) -> None:
        """Run one callback, waiting until the future is done or the time is over."""
        with self._woken_by(future):
            self._spin_once(timeout_sec, future.done)

    @contextmanager
    def _woken_by(self, future: Future) -> Iterator[None]:
        """Look at everything anew when a future is done."""

        def wake(_: Future) -> None:
            self.wake()

        future.add_done_callback(wake)
        try:
            yield
        finally:
            future._remove_done_callback(wake)

    def _spin_once(self, timeout_sec: float | None, condition: Callable[[], bool]) -> None:
        entity = self._next_ready(timeout_sec, condition)
        if entity is not None:
            self._run(entity)

    def _next_ready(self, timeout_sec: float | None, condition: Callable[[], bool]) -> Any:
        """The entity to run next; None when none is ready in time, or the wait is ended.

        Whatever is ready at once runs in one round, each once, before anything runs again.

        Raises:
            ExternalShutdownException: the context is down.
        """
        forever = timeout_sec is None or timeout_sec < 0
        deadline = None if forever else time.monotonic() + (timeout_sec or 0.0)
        entity = next(self._round, None)
        while entity is None and not self._is_shutdown and not condition():
            rest = self._time_to_wait(deadline)
            if rest is None or rest > 0:
                self._wake_up.wait(rest)
            if self._is_shutdown:
                break
            if not self._context.ok():
                raise ExternalShutdownException()
            self._round = self._ready()
            entity = next(self._round, None)
            if deadline is not None and time.monotonic() >= deadline:
                break
        return None if self._is_shutdown else entity

    def _ready(self) -> Iterator[Any]:
        """The entities that may start, each examined when its turn comes, in rclpy's order."""
        for node in self.get_nodes():
            for entity in node._rcl_entities():
                if node not in self._nodes:
                    break
                if entity._may_be_ready() and self._may_start(entity) and entity._fetch():
                    entity._executor_event = True
                    yield entity

    def _may_start(self, entity: Any) -> bool:
        return not entity._executor_event and entity.callback_group.can_execute(entity)

    def _time_to_wait(self, deadline: float | None) -> float | None:
        """Seconds until a timer is due or the deadline comes; 0 when something may be ready.

        None stands for ever: only a message, a trigger or the like will end that.
        """
        rest = None if deadline is None else deadline - time.monotonic()
        for node in self.get_nodes():
            if any(e._may_be_ready() and self._may_start(e) for e in node._rcl_entities()):
                return 0.0
            for timer in list(node.timers):
                until_due = timer._real_time_left()
                if until_due is not None and self._may_start(timer):
                    seconds = until_due / S_TO_NS
                    rest = seconds if rest is None else min(rest, seconds)
        return rest

    def _run(self, entity: Any) -> None:
        """Call an entity's callback, unless its group is busy after all."""
        if self._is_shutdown or not entity.callback_group.beginning_execution(entity):
            entity._executor_event = False
            self.wake()
            return
        self._running.begin()
        try:
            call = None
            try:
                with suppress(InvalidHandle):  # it was destroyed meanwhile
                    call = entity._take()
            finally:  # the next data may be looked at
                entity._executor_event = False
                if self._runs_elsewhere:
                    self.wake()
            if call is not None:
                call()
        finally:
            self._running.end()
            entity.callback_group.ending_execution(entity)
            if self._runs_elsewhere:
                self.wake()

    def __enter__(self) -> "Executor":
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()


class SingleThreadedExecutor(Executor):
    """Runs callbacks in the thread that spins."""


class MultiThreadedExecutor(Executor):
    """Runs callbacks in several threads, as far as callback groups allow."""

    _runs_elsewhere = True

    def __init__(self, num_threads: int | None = None, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        if num_threads is None:
            has_affinity = hasattr(os, "sched_getaffinity")
            num_threads = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 2
        if num_threads == 1:
            warnings.warn(
                "MultiThreadedExecutor is used with a single thread.\n"
                "Use the SingleThreadedExecutor instead.",
                stacklevel=2,
            )
        self._errors: list[BaseException] = []
        self._executor = ThreadPoolExecutor(num_threads, thread_name_prefix="rclpy")

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        ended = super().shutdown(timeout_sec)
        self._executor.shutdown(wait=False)
        return ended

    def _spin_once(self, timeout_sec: float | None, condition: Callable[[], bool]) -> None:
        try:
            entity = self._next_ready(timeout_sec, lambda: bool(self._errors) or condition())
        except ExternalShutdownException:
            entity = None
        if entity is not None:
            self._executor.submit(self._run_and_keep_error, entity)
        if self._errors:
            raise self._errors.pop(0)

    def _run_and_keep_error(self, entity: Any) -> None:
        try:
            self._run(entity)
        except Exception as error:
            self._errors.append(error)
            self.wake()
