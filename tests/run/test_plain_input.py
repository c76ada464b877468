"""What the system gives a run that cannot be used is said before a node starts, in a sentence."""

import threading

import pytest

from us_sim.errors import UsSimError
from us_sim.run.graph import NodeProcess, ProcessGroup


@pytest.mark.parametrize("value", ["\udcff.mcap", ["a", "\udcff"]])
def test_a_name_that_is_no_text_is_refused(value):
    with pytest.raises(UsSimError, match=r"file: .*udcff.* is no text in UTF-8"):
        NodeProcess("session_recorder", {"file": value})


def test_without_threads_no_process_is_left(monkeypatch):
    def refuse(_):
        raise RuntimeError("can't start new thread")

    group = ProcessGroup()
    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(UsSimError, match="probe_tracker cannot be followed: can't"):
        group.start([NodeProcess("probe_tracker")])
    monkeypatch.undo()
    assert group.stop() == []
