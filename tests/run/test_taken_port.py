"""A port that another program has is said before anything is made for the page."""

import socket

import pytest

from us_sim.errors import UsSimError
from us_sim.run import live
from us_sim.run.watch import SupervisionSettings
from us_sim.scene.reading import load_scene
from us_sim.settings.viewer import ViewerSettings


@pytest.fixture
def taken():
    """A port that is listened at."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield other.getsockname()[1]


def fail(*_):
    raise AssertionError("it has begun")


def test_a_taken_port_is_said_before_the_volume_is_made(small_scene, taken, monkeypatch):
    monkeypatch.setattr(live, "prepare_volume", fail)
    scene, view = load_scene(small_scene), ViewerSettings(port=taken)
    with pytest.raises(UsSimError, match=f"port {taken} of 127.0.0.1 is taken: choose another"):
        live.run(
            scene,
            {},
            record=None,
            path=None,
            duration=None,
            network=False,
            supervision=SupervisionSettings(),
            view=view,
        )


@pytest.mark.parametrize("view", [ViewerSettings(), None])
def test_a_taken_port_is_said_before_the_viewer_starts(taken, monkeypatch, view):
    monkeypatch.setattr(live, "follow", fail)
    given = {} if view is None else {"viewer": {"port": str(taken)}}
    with pytest.raises(UsSimError, match="is taken: choose another with --port"):
        live.view_running(
            view or ViewerSettings(port=taken),
            given,
            network=False,
            supervision=SupervisionSettings(),
        )
