"""What executors have in common: they wait until something is ready, and find its callback.

Waiting costs nothing: data, triggers, shutdown and the like wake the waiting thread.
"""

import inspect
import threading
import time
from collections.abc import Callable, Coroutine, Generator
from contextlib import AbstractContextManager
from types import TracebackType
from typing import TYPE_CHECKING, Any

from ._executor_outcomes import (
    ConditionReachedException,
    ExternalShutdownException,
    ShutdownException,
    TimeoutException,
    TimeoutObject,
)
from ._executor_work import WorkTracker, take_call
from ._readiness import ready_entities, time_to_wait
from ._wake_up import WakeUp
from .context import Context
from .exceptions import NotInitializedException
from .task import Future, Task
from .utilities import get_default_context

if TYPE_CHECKING:
    from .node import Node

__all__ = ["Executor", "Work", "never"]


def never() -> bool:
    """The condition of a wait that nothing but readiness and time ends."""
    return False


Work = tuple[Task, Any, "Node | None"]


class Executor(AbstractContextManager["Executor"]):
    """What SingleThreadedExecutor and MultiThreadedExecutor have in common."""

    _wakes_after_callbacks = False  # needed when callbacks run in other threads

    def __init__(self, *, context: Context | None = None) -> None:
        self._context = get_default_context() if context is None else context
        if self._context.handle is None:
            raise NotInitializedException("cannot create executor")
        self._nodes: dict[Node, None] = {}
        self._nodes_lock = threading.RLock()
        self._tasks: list[Work] = []
        self._tasks_lock = threading.Lock()
        self._wake_up = WakeUp()
        self._context.handle.register(self._wake_up)
        self._is_shutdown = False
        self._work_tracker = WorkTracker()
        self._cb_iter: Generator[Work, None, None] | None = None
        self._last_arguments: Any = None

    @property
    def context(self) -> Context:
        return self._context

    def create_task(
        self, callback: Callable[..., Any] | Coroutine, *args: Any, **kwargs: Any
    ) -> Task:
        """Run a function or coroutine once, soon; the task is the future of its result."""
        task = Task(callback, args, kwargs, executor=self)
        self._enqueue((task, None, None))
        return task

    def _enqueue(self, work: Work) -> None:
        with self._tasks_lock:
            self._tasks.append(work)
        self.wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Start no more callbacks, and wait for those that run in other threads.

        Returns:
            False when they did not end within the timeout.
        """
        self._is_shutdown = True
        self.wake()
        if not self._work_tracker.wait(timeout_sec):
            return False
        with self._nodes_lock:
            self._nodes = {}
        self._cb_iter = None
        self._last_arguments = None
        return True

    def add_node(self, node: "Node") -> bool:
        """Run a node's callbacks; False when it was added before."""
        with self._nodes_lock:
            if node in self._nodes:
                return False
            self._nodes[node] = None
            node.executor = self
        self.wake()
        return True

    def remove_node(self, node: "Node") -> None:
        """Run a node's callbacks no more."""
        with self._nodes_lock:
            if node in self._nodes:
                del self._nodes[node]
                self.wake()

    def wake(self) -> None:
        """Have the waiting thread look at everything anew."""
        self._wake_up.wake()

    def get_nodes(self) -> "list[Node]":
        """The nodes that were added."""
        with self._nodes_lock:
            return list(self._nodes)

    def spin(self) -> None:
        """Run callbacks until the context or this executor is shut down."""
        while self._context.ok() and not self._is_shutdown:
            self.spin_once()

    def spin_until_future_complete(self, future: Future, timeout_sec: float | None = None) -> None:
        """Run callbacks until a future is done, or the time is over."""
        future._when_done(self.wake)
        if timeout_sec is None or timeout_sec < 0:
            while self._context.ok() and not future.done() and not self._is_shutdown:
                self.spin_once_until_future_complete(future, timeout_sec)
            return
        end = time.monotonic() + timeout_sec
        timeout_left = TimeoutObject(timeout_sec)
        while self._context.ok() and not future.done() and not self._is_shutdown:
            self.spin_once_until_future_complete(future, timeout_left)
            timeout_left.timeout = end - time.monotonic()
            if timeout_left.timeout <= 0:
                return

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Run one callback, waiting for one to be ready until the time is over."""
        self._spin_once(timeout_sec, never)

    def spin_once_until_future_complete(
        self, future: Future, timeout_sec: float | TimeoutObject | None = None
    ) -> None:
        """Run one callback, waiting until the future is done or the time is over."""
        future._when_done(self.wake)
        self._spin_once(timeout_sec, future.done)

    if TYPE_CHECKING:

        def _spin_once(
            self, timeout_sec: float | TimeoutObject | None, condition: Callable[[], bool]
        ) -> None: ...

    def can_execute(self, entity: Any) -> bool:
        """Whether an entity's callback may start now."""
        return not entity._executor_event and entity.callback_group.can_execute(entity)

    def wait_for_ready_callbacks(
        self, *args: Any, **kwargs: Any
    ) -> "tuple[Task, Any, Node | None]":
        """The next callback that is ready, with its entity and node.

        Args:
            timeout_sec: seconds to wait; None or negative for ever.
            nodes: only callbacks of these; those that were added when None.
            condition: a function that ends the wait when it returns true.

        Raises:
            TimeoutException, ShutdownException, ExternalShutdownException,
            ConditionReachedException: why there is none.
        """
        while True:
            if self._cb_iter is None or self._last_arguments != (args, kwargs):
                self._last_arguments = (args, kwargs)
                self._cb_iter = self._ready_callbacks(*args, **kwargs)
            try:
                return next(self._cb_iter)
            except StopIteration:
                self._cb_iter = None

    def _ready_callbacks(
        self,
        timeout_sec: float | TimeoutObject | None = None,
        nodes: "list[Node] | None" = None,
        condition: Callable[[], bool] = never,
    ) -> Generator[Work, None, None]:
        timeout = timeout_sec.timeout if isinstance(timeout_sec, TimeoutObject) else timeout_sec
        deadline = None if timeout is None or timeout < 0 else time.monotonic() + timeout
        has_yielded = False
        while not has_yielded and not self._is_shutdown and not condition():
            nodes_to_use = self.get_nodes() if nodes is None else nodes
            for work in self._take_tasks(nodes_to_use):
                has_yielded = True
                yield work
            if not has_yielded:
                rest = time_to_wait(nodes_to_use, self.can_execute, deadline)
                if rest is None or rest > 0:
                    self._wake_up.wait(rest)
            if self._is_shutdown:
                raise ShutdownException()
            if not self._context.ok():
                raise ExternalShutdownException()
            for node in nodes_to_use:
                for entity in ready_entities(node, self.can_execute):
                    has_yielded = True
                    yield self._work_for(entity, node)
            if not has_yielded and deadline is not None and time.monotonic() >= deadline:
                with self._tasks_lock:
                    has_tasks = bool(self._tasks)
                if not has_tasks:
                    raise TimeoutException()
        if self._is_shutdown:
            raise ShutdownException()
        if condition():
            raise ConditionReachedException()

    def _take_tasks(self, nodes: "list[Node]") -> Generator[Work, None, None]:
        """The tasks there are now, the latest first, each removed when its turn comes."""
        if not self._tasks:
            return
        with self._tasks_lock:
            waiting = self._tasks[::-1]
        for work in waiting:
            if work[2] is None or work[2] in nodes:
                with self._tasks_lock:
                    if work not in self._tasks:
                        continue
                    self._tasks.remove(work)
                yield work

    def _work_for(self, entity: Any, node: "Node") -> Work:
        entity._executor_event = True
        callback = getattr(entity, "callback", None)
        if inspect.iscoroutinefunction(callback) or hasattr(entity, "execute"):
            handler: Callable[..., Any] = self._execute_coroutine
        else:
            handler = self._execute
        return Task(handler, (entity,), executor=self), entity, node

    def _execute(self, entity: Any) -> None:
        if not self._begin(entity):
            return
        try:
            call = self._take(entity)
            if call is not None:
                call()
        finally:
            self._end(entity)

    async def _execute_coroutine(self, entity: Any) -> None:
        if not self._begin(entity):
            return
        try:
            call = self._take(entity)
            if call is not None:
                await call()
        finally:
            self._end(entity)

    def _begin(self, entity: Any) -> bool:
        if self._is_shutdown or not entity.callback_group.beginning_execution(entity):
            entity._executor_event = False
            self.wake()
            return False
        self._work_tracker.begin()
        return True

    def _take(self, entity: Any) -> Callable[[], Any] | None:
        try:
            return take_call(entity, self)
        finally:
            entity._executor_event = False
            if self._wakes_after_callbacks:
                self.wake()

    def _end(self, entity: Any) -> None:
        self._work_tracker.end()
        entity.callback_group.ending_execution(entity)
        if self._wakes_after_callbacks:
            self.wake()

    def _run(self, work: Work) -> None:
        """Run a task to its end or its next await, and see to it that it goes on after that."""
        task = work[0]
        task()
        if not task.done():
            awaited = task._waits_for
            if awaited is None:
                self._enqueue(work)
            else:
                awaited._when_done(lambda: self._enqueue(work))

    def __enter__(self) -> "Executor":
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_val: BaseException | None,
        exc_tb: TracebackType | None,
    ) -> None:
        self.shutdown()
