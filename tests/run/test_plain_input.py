"""What the system gives a run that cannot be used is said before a node starts, in a sentence."""

import os
import signal
import threading

import pytest

from us_sim.errors import UsSimError
from us_sim.run.plan import NodeProcess
from us_sim.run.processes import ProcessGroup


@pytest.mark.parametrize("value", ["\udcff.mcap", ["a", "\udcff"]])
def test_a_name_that_is_no_text_is_refused(value):
    with pytest.raises(UsSimError, match=r"file: .*udcff.* is no text in UTF-8"):
        NodeProcess("session_recorder", {"file": value})


def test_ctrl_c_while_a_process_is_started_is_heard():
    """Python itself forgets what is raised in what `logging` does around a fork."""
    forking = []

    def interrupt():
        if forking and forking.pop() == os.getpid():
            os.kill(os.getpid(), signal.SIGINT)

    os.register_at_fork(after_in_parent=interrupt)
    group = ProcessGroup()
    forking.append(os.getpid())
    try:
        with pytest.raises(KeyboardInterrupt):
            group.start([NodeProcess("probe_tracker")])
        assert group.is_running("probe_tracker")  # and so it can be ended
    finally:
        group.stop()


def test_without_threads_no_process_is_left(monkeypatch):
    def refuse(_):
        raise RuntimeError("can't start new thread")

    group = ProcessGroup()
    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(UsSimError, match="probe_tracker cannot be followed: can't"):
        group.start([NodeProcess("probe_tracker")])
    monkeypatch.undo()
    assert group.stop() == []
