"""`us-sim view` in a process of its own, until a test has looked at its page."""

import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
from awaiting import until

START_S = 240.0
"""For what may have to be compiled first."""


@contextmanager
def served_view(folder: Path, *words: object) -> Iterator[SimpleNamespace]:
    """The command's ``process``, its first ``address``, and the ``log`` of what it says.

    Afterwards it is interrupted, and must have said no traceback.
    """
    pytest.importorskip("nicegui", reason="nicegui is not installed")
    log = folder / "view.log"
    command = [sys.executable, "-m", "us_sim", "view", *map(str, words), "--port", "0"]
    with log.open("w") as output:
        process = subprocess.Popen(command, cwd=folder, stdout=output, stderr=subprocess.STDOUT)
    try:
        found = until(
            lambda: process.poll() is not None or re.search(r"http://\S+", log.read_text()),
            "the address is printed",
            START_S,
        )
        assert process.poll() is None, log.read_text()
        yield SimpleNamespace(process=process, address=found[0], log=log)
    finally:
        process.send_signal(signal.SIGINT)
        killer = threading.Timer(30.0, process.kill)
        killer.start()
        process.wait()
        killer.cancel()
    assert "Traceback" not in log.read_text()
