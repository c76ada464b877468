"""Executors: they wait until something is ready and run its callback.

>>> from us_sim.standalone.rclpy.context import Context
>>> with Context() as context, SingleThreadedExecutor(context=context) as executor:
...     task = executor.create_task(max, 3, 5)
...     executor.spin_once(timeout_sec=1.0)
>>> task.result()
5
"""

import os
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from ._executor import Executor, Work, never
from ._executor_outcomes import (
    ConditionReachedException,
    ExternalShutdownException,
    ShutdownException,
    TimeoutException,
    TimeoutObject,
)
from .context import Context
from .task import Task

__all__ = [
    "ConditionReachedException",
    "Executor",
    "ExternalShutdownException",
    "MultiThreadedExecutor",
    "ShutdownException",
    "SingleThreadedExecutor",
    "TimeoutException",
    "TimeoutObject",
]


class SingleThreadedExecutor(Executor):
    """Runs callbacks in the thread that spins."""

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)

    def _spin_once(
        self, timeout_sec: float | TimeoutObject | None, condition: Callable[[], bool]
    ) -> None:
        try:
            work = self.wait_for_ready_callbacks(timeout_sec, None, condition)
        except (ShutdownException, TimeoutException, ConditionReachedException):
            return
        self._run(work)
        error = work[0].exception()
        if error is not None:
            raise error


class MultiThreadedExecutor(Executor):
    """Runs callbacks in several threads, as far as callback groups allow."""

    _wakes_after_callbacks = True

    def __init__(self, num_threads: int | None = None, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        if num_threads is None:
            if hasattr(os, "sched_getaffinity"):
                num_threads = len(os.sched_getaffinity(0))
            else:
                num_threads = os.cpu_count() or 2
        if num_threads == 1:
            warnings.warn(
                "MultiThreadedExecutor is used with a single thread.\n"
                "Use the SingleThreadedExecutor instead.",
                stacklevel=2,
            )
        self._failed: list[Task] = []
        self._executor = ThreadPoolExecutor(num_threads, thread_name_prefix="rclpy")

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        ended = super().shutdown(timeout_sec)
        self._executor.shutdown(wait=False)
        return ended

    def _spin_once(
        self, timeout_sec: float | TimeoutObject | None, condition: Callable[[], bool]
    ) -> None:
        if condition is never:
            condition = self._has_failures
        try:
            work = self.wait_for_ready_callbacks(timeout_sec, None, condition)
        except (
            ExternalShutdownException,
            ShutdownException,
            TimeoutException,
            ConditionReachedException,
        ):
            pass
        else:
            self._executor.submit(self._run, work)
        self._raise_failures()

    def _run(self, work: Work) -> None:
        super()._run(work)
        if work[0]._exception is not None:
            self._failed.append(work[0])
            self.wake()

    def _has_failures(self) -> bool:
        return bool(self._failed)

    def _raise_failures(self) -> None:
        if self._failed:
            raise self._failed.pop(0).exception()
