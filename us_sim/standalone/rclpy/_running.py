"""Which threads run callbacks now."""

import threading


class RunningCallbacks:
    """Counts the callbacks that run, by thread."""

    def __init__(self) -> None:
        self._threads: dict[int, int] = {}
        self._changed = threading.Condition()

    def begin(self) -> None:
        """This thread runs a callback."""
        me = threading.get_ident()
        with self._changed:
            self._threads[me] = self._threads.get(me, 0) + 1

    def end(self) -> None:
        """This thread has run a callback."""
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
