"""Live runs: refused before anything is made, and their status on the terminal."""

import socket
from types import SimpleNamespace
from typing import Any

import pytest

from us_sim.errors import UsSimError
from us_sim.run import live
from us_sim.run.live import _status
from us_sim.run.plan import Plan, RunRequest, plan_viewer
from us_sim.run.supervision import SupervisionSettings
from us_sim.scene.reading import load_scene
from us_sim.settings.viewer import ViewerSettings


@pytest.mark.parametrize(
    ("host", "address"),
    [("127.0.0.1", "http://127.0.0.1:8123/"), ("::1", "http://[::1]:8123/"), ("0.0.0.0", "token")],
)
def test_a_run_that_waits_says_where_its_page_is(host: str, address: str) -> None:
    plan = Plan([plan_viewer(ViewerSettings(host=host, port=0))])
    monitor: Any = SimpleNamespace(
        reports={"viewer": {"port": "8123"}}, count_messages=lambda *_: 0
    )
    assert address in _status(plan, monitor)


@pytest.fixture
def taken():
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield other.getsockname()[1]


def fail(*_):
    raise AssertionError("it has begun")


def test_a_taken_port_is_said_before_the_volume_is_made(small_scene, taken, monkeypatch):
    monkeypatch.setattr(live, "prepare_scene", fail)
    scene, view = load_scene(small_scene), ViewerSettings(port=taken)
    request = RunRequest(scene, view=view)
    with pytest.raises(UsSimError, match=f"port {taken} of 127.0.0.1 is taken: choose another"):
        live.run_scene(request, SupervisionSettings())


@pytest.mark.parametrize("view", [ViewerSettings(), None])
def test_a_taken_port_is_said_before_the_viewer_starts(taken, monkeypatch, view):
    monkeypatch.setattr(live, "follow_plan", fail)
    given = {} if view is None else {"viewer": {"port": str(taken)}}
    with pytest.raises(UsSimError, match="is taken: choose another with --port"):
        live.view_running(view or ViewerSettings(port=taken), given, SupervisionSettings())
