"""Signals that wait for a moment in which what they raise is heard.

Python forgets what a signal's handler raises within some of its own callbacks, such as those of
`logging` around a fork: Ctrl-C would then do nothing.

>>> import os, signal
>>> from us_sim.run.deferred_signals import deferred_signals
>>> heard = []
>>> before = signal.signal(signal.SIGINT, lambda *_: heard.append("interrupted"))
>>> with deferred_signals():
...     os.kill(os.getpid(), signal.SIGINT)
...     heard.append("done")
>>> heard
['done', 'interrupted']
>>> _ = signal.signal(signal.SIGINT, before)
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def deferred_signals() -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP that come within the context are handled at its end.

    Where they are ignored, or not handled in Python, nothing changes; in other threads than the
    main one neither, since no handler runs there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handlers = {
        number: handler for number in _NUMBERS if callable(handler := signal.getsignal(number))
    }
    for number in handlers:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for each in came:
            handlers[signal.Signals(each)](each, None)
