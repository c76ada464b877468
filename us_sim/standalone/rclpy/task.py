"""Results that come later."""

import sys
import threading
import warnings
from collections.abc import Callable
from typing import Any


class Future:
    """A result, an exception, or nothing yet."""

    def __init__(self, *, executor=None):  # noqa: ARG002
        self._done = False
        self._cancelled = False
        self._result: Any = None
        self._exception: BaseException | None = None
        self._exception_fetched = False
        self._callbacks: list[Callable[[Any], Any]] = []
        self._lock = threading.Lock()

    def __del__(self):
        if self._exception is not None and not self._exception_fetched:
            print(
                f"The following exception was never retrieved: {self._exception}", file=sys.stderr
            )

    def cancel(self):
        """Say that nobody wants the result any more; callbacks are called."""
        with self._lock:
            if not self._done:
                self._cancelled = True
        self._call_back()

    def cancelled(self):
        return self._cancelled

    def done(self):
        return self._done

    def result(self):
        """The result, None when there is none yet; raises the exception if there is one."""
        if self._exception is not None:
            raise self.exception()
        return self._result

    def exception(self):
        self._exception_fetched = True
        return self._exception

    def set_result(self, result):
        self._conclude(result, None)
        self._call_back()

    def set_exception(self, exception):
        self._conclude(None, exception)
        self._call_back()

    def add_done_callback(self, callback):
        """Have a function called with this future once it is done, or now if it is."""
        with self._lock:
            if not self._done:
                self._callbacks.append(callback)
                return
        callback(self)

    def _remove_done_callback(self, callback: Callable[[Any], Any]) -> None:
        """Call it no more, if it has not been called."""
        with self._lock:
            if callback in self._callbacks:
                self._callbacks.remove(callback)

    def _conclude(self, result: Any, exception: BaseException | None) -> None:
        with self._lock:
            self._result, self._exception = result, exception
            self._exception_fetched = False
            self._done = True
            self._cancelled = False

    def _set_result_in_executor(self, result: Any) -> None:
        """Be done, with a result; errors of callbacks reach whoever spins."""
        self._conclude(result, None)
        for callback in self._taken_callbacks():
            callback(self)

    def _call_back(self) -> None:
        for callback in self._taken_callbacks():
            try:
                callback(self)
            except Exception as error:
                warnings.warn(f"Unhandled exception in done callback: {error}", stacklevel=3)

    def _taken_callbacks(self) -> list[Callable[[Any], Any]]:
        with self._lock:
            callbacks, self._callbacks = self._callbacks, []
        return callbacks
