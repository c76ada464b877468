"""A simulation that is asked for other things while it runs, by parameters alone."""

import os
import signal
import sys

import pytest
from many_restarts import nodes_of
from remote_control import RemoteControl, started

from us_sim.recording.reader import read_bag

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's /proc")


@pytest.fixture
def simulation(small_scene, tmp_path):
    """`us-sim run` in another process, and its remote control."""
    control = RemoteControl()
    run = started("run", small_scene, cwd=tmp_path)
    try:
        yield run, control
    finally:
        run.send_signal(signal.SIGINT)
        said = run.communicate(timeout=30)[1]
        control.close()
    assert "Traceback" not in said
    assert run.returncode in (1, 130)


def test_scenes_recordings_and_replays_are_changed_while_it_runs(
    simulation, small_scene, short_path, tmp_path
):
    run, control = simulation
    other = small_scene.with_name("other.yaml")
    other.write_text(
        f"based_on: {small_scene}\nname: other\nskin: null\nprobe: {{image: [60, 50]}}\n"
    )
    control.until(lambda: control.state == "running")
    before = nodes_of(run.pid)

    # A node that is ended starts as it did at first.
    stiffness = "materials.fat.young_modulus"
    first = control.value(stiffness, "tissue_deformer")
    assert control.set("tissue_deformer", **{stiffness: 45e3}) == ""
    os.kill(before["tissue_deformer"], signal.SIGKILL)
    control.until(lambda: control.state.startswith("starting"))
    control.until(lambda: control.state == "running")
    assert control.value(stiffness, "tissue_deformer") == first
    before = nodes_of(run.pid)

    # A path is played, and recorded; nobody else is started again.
    assert control.set(record="session.mcap", replay=str(short_path), replay_loop=True) == ""
    control.until(lambda: control.images > 10 and control.report("session_recorder"))
    assert "exists already" in control.set(record="session.mcap")
    assert control.set(replay_paused=True) == ""
    control.until(lambda: control.report().get("replay_state") == "paused")
    assert control.set(replay_time=0.5) == ""
    control.until(lambda: control.report().get("position") == "0.500")
    assert control.set(record="") == ""
    control.until(lambda: "session_recorder" not in nodes_of(run.pid))
    assert control.set(replay="") == ""
    control.until(lambda: nodes_of(run.pid).keys() == before.keys() and control.state == "running")
    after = nodes_of(run.pid)  # the tracker took poses from its own source meanwhile
    assert {node for node in after if after[node] != before[node]} == {"probe_tracker"}
    control.until(lambda: not read_bag(tmp_path / "session.mcap").fault)  # it has its index
    bag = read_bag(tmp_path / "session.mcap")
    assert bag.find_topic("/ultrasound/image").message_count > 5

    # Scenes that cannot be are refused, and nothing changes.
    assert "there is no scene file nowhere" in control.set(scene="nowhere")
    other_broken = small_scene.with_name("broken.yaml")
    other_broken.write_text(f"based_on: {small_scene}\ntissue: {{fixed: [nothing]}}\n")
    assert "no label `nothing`" in control.set(scene=str(other_broken))
    assert control.value("scene") == str(small_scene)

    # Another scene.
    control.states.clear()
    assert control.set(scene=str(other)) == ""
    control.until(lambda: control.state == "running" and control.report()["scene"] == "other")
    assert any(state.startswith("starting: ") for state in control.states)
    assert set(nodes_of(run.pid)) == {"probe_tracker", "tissue_deformer", "slice_interpolator"}
    assert control.set(replay=str(short_path)) == ""
    control.until(lambda: control.size == (60, 50))

    # What was recorded takes the place of the simulation.
    whole = {"replay": str(tmp_path / "session.mcap"), "replay_as": "recording"}
    assert control.set(**whole, replay_loop=True) == ""  # a second is over before it is heard
    control.until(lambda: control.size == (96, 80))
    assert set(nodes_of(run.pid)) == {"session_player"}

    # The first scene again.
    assert control.set(replay="", scene=str(small_scene)) == ""
    control.until(lambda: control.state == "running" and control.report()["scene"] == "small")

    control.until(lambda: "small" in control.scenes)
    listed = control.scenes["upper_arm"]
    assert listed.message.startswith("Procedural upper arm")
    assert run.poll() is None
    assert os.path.exists(tmp_path / "session.mcap")
