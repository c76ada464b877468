"""Results that come later, and the work that makes them.

>>> future = Future()
>>> future.add_done_callback(lambda done: print("got", done.result()))
>>> future.set_result(3)
got 3
"""

import inspect
import sys
import threading
import warnings
import weakref
from collections.abc import Callable
from typing import Any

__all__ = ["Future", "Task"]


class Future:
    """A result, an exception, or nothing yet."""

    def __init__(self, *, executor=None):
        self._done = False
        self._cancelled = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._exception_fetched = False
        self._callbacks: list[Callable[[Any], Any]] = []
        self._resumers: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._executor: weakref.ReferenceType[Any] | None = None
        self._set_executor(executor)

    def __del__(self):
        if self._exception is not None and not self._exception_fetched:
            print(
                f"The following exception was never retrieved: {self._exception}", file=sys.stderr
            )

    def __await__(self):
        while not self._done:
            yield self  # tells the task that awaits this what it is waiting for
        return self.result()

    def cancel(self):
        """Say that nobody wants the result any more; callbacks are called."""
        with self._lock:
            if not self._done:
                self._cancelled = True
        self._schedule_or_invoke_done_callbacks()

    def cancelled(self):
        """Whether it was cancelled before it was done."""
        return self._cancelled

    def done(self):
        """Whether there is a result or an exception."""
        return self._done

    def result(self):
        """The result, None when there is none yet; raises the exception if there is one."""
        if self._exception is not None:
            raise self.exception()
        return self._result

    def exception(self):
        """The exception, or None."""
        self._exception_fetched = True
        return self._exception

    def set_result(self, result):
        """Be done, with a result."""
        with self._lock:
            self._result = result
            self._done = True
            self._cancelled = False
        self._schedule_or_invoke_done_callbacks()

    def set_exception(self, exception):
        """Be done, with an exception."""
        with self._lock:
            self._exception = exception
            self._exception_fetched = False
            self._done = True
            self._cancelled = False
        self._schedule_or_invoke_done_callbacks()

    def add_done_callback(self, callback):
        """Have a function called with this future once it is done, or now if it is.

        With an executor the call is a task of the executor.
        """
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                return
            executor = self._executor() if self._executor is not None else None
        if executor is not None:
            executor.create_task(callback, self)
        else:
            callback(self)

    def _set_executor(self, executor: Any) -> None:
        with self._lock:
            self._executor = None if executor is None else weakref.ref(executor)

    def _when_done(self, resume: Callable[[], None]) -> None:
        """Have a task that awaits this go on, at once in the thread that makes this done."""
        with self._lock:
            if not self._done:
                self._resumers.append(resume)
                return
        resume()

    def _schedule_or_invoke_done_callbacks(self) -> None:
        with self._lock:
            resumers: list[Callable[[], None]] = []
            if self._done:
                resumers, self._resumers = self._resumers, []
            executor = self._executor() if self._executor is not None else None
            callbacks, self._callbacks = self._callbacks, []
        for resume in resumers:
            resume()
        for callback in callbacks:
            if executor is not None:
                executor.create_task(callback, self)
            else:
                try:
                    callback(self)
                except Exception as error:
                    warnings.warn(f"Unhandled exception in done callback: {error}", stacklevel=2)


class Task(Future):
    """A function or coroutine to be run by an executor; the future of what it returns."""

    def __init__(self, handler, args=None, kwargs=None, executor=None):
        super().__init__(executor=executor)
        self._handler: Any = handler
        self._args = () if args is None else args
        self._kwargs = {} if kwargs is None else kwargs
        if inspect.iscoroutinefunction(handler):
            self._handler = handler(*self._args, **self._kwargs)
        self._is_coroutine = inspect.iscoroutine(self._handler)
        self._executing = False
        self._task_lock = threading.Lock()
        self._waits_for: Future | None = None

    def __call__(self):
        """Run, up to the end or to the next await of something that is not done."""
        if self._done or self._executing or not self._task_lock.acquire(blocking=False):
            return
        try:
            if self._done:
                return
            self._executing = True
            try:
                if self._is_coroutine:
                    awaited = self._handler.send(None)
                    self._waits_for = awaited if isinstance(awaited, Future) else None
                else:
                    self._finish(self.set_result, self._handler(*self._args, **self._kwargs))
            except StopIteration as stop:
                self._finish(self.set_result, stop.value)
            except Exception as error:
                self._finish(self.set_exception, error)
            self._executing = False
        finally:
            self._task_lock.release()

    def _finish(self, conclude: Callable[[Any], None], outcome: Any) -> None:
        self._handler, self._args, self._kwargs = None, (), {}
        self._waits_for = None
        conclude(outcome)

    def executing(self):
        """Whether it runs right now."""
        return self._executing
