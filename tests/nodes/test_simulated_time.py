"""The graph from the tracker to the image under simulated time, which a player publishes."""

import numpy as np
import pytest
from bench import Bench
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image
from std_msgs.msg import String

from us_sim.nodes.messages import stamp_message
from us_sim.nodes.path_player import PathPlayer
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.nodes.session_recorder import SessionRecorder
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.nodes.tissue_deformer import TissueDeformer
from us_sim.recording.path import ProbePath, write_path
from us_sim.recording.reader import read_bag

EPOCH = 1_700_000_000_000_000_000
STEP = 20_000_000
POSES = 300
DEPTHS = 0.004 * np.sin(np.arange(POSES) / 20.0)  # m
NODES = {"probe_tracker", "tissue_deformer", "slice_interpolator"}


class Graph:
    """The nodes of a scene that follow the clock of a player, and what they send."""

    def __init__(self, bench: Bench, scene: str, bag: str) -> None:
        self.bench = bench
        self.images = bench.collect(Image, "ultrasound/image")
        self.poses = bench.collect(PoseStamped, "probe/pose")
        self._reports = bench.collect(DiagnosticArray, "diagnostics")
        common = {"scene": scene, "use_sim_time": True}
        bench.make(TissueDeformer, **common)
        self.imager = bench.make(SliceInterpolator, **common)
        self.tracker = bench.make(ProbeTracker, source="pose", **common)
        given = {"clock": 100.0, "stay": True, "use_sim_time": True, "paused": True}
        self.player = bench.make(PathPlayer, path=bag, **given)

    def set(self, **values: object) -> None:
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        assert self.player.set_parameters_atomically(parameters).successful

    def spin_for(self, seconds: float) -> None:
        until = self.tracker._steady.now().nanoseconds + 1e9 * seconds
        self.bench.spin_until(lambda: self.tracker._steady.now().nanoseconds > until)

    def reports(self, seconds: float) -> dict[str, list[dict[str, object]]]:
        self._reports.clear()
        self.spin_for(seconds)
        told: dict[str, list[dict[str, object]]] = {name: [] for name in NODES}
        for report in self._reports:
            for status in report.status:
                values = {item.key: item.value for item in status.values}
                told.setdefault(status.name.strip("/"), []).append(
                    {"level": status.level, "message": status.message, **values}
                    | {"stamp": report.header.stamp}
                )
        return told


def path_of(folder):
    positions = np.column_stack([np.zeros((POSES, 2)), DEPTHS])
    orientations = np.tile([0.0, 0, 0, 1], (POSES, 1))
    bag = folder / "path" / "path.mcap"
    stamps = EPOCH + STEP * np.arange(POSES)
    write_path(bag, ProbePath("/tracker/pose", "patient", stamps, positions, orientations))
    return bag


@pytest.fixture
def graph(bench, small_scene, tmp_path):
    graph = Graph(bench, str(small_scene), str(path_of(tmp_path)))
    bench.spin_until(lambda: graph.player.health.state == "paused")
    graph.set(time=0.0)
    bench.spin_until(lambda: graph.images, limit=100.0)
    return graph


def stamps(messages):
    return np.array([Time.from_msg(m.header.stamp).nanoseconds - EPOCH for m in messages])


def require_sound(reports):
    """Nodes report every real second, nothing keeps them from work, and latency is plausible."""
    for node in NODES:
        assert len(reports[node]) >= 2
        last = reports[node][-1]
        # Poses that a busy machine plays after the recording's end all have the time of its end.
        late = "not newer" in last["message"]
        assert last["level"] == DiagnosticStatus.OK or late, last
        assert 0.0 < float(last["latency_p50_ms"]) < 1000.0
    assert reports["probe_tracker"][-1]["state"] == "tracked"


@pytest.mark.parametrize("rate", [0.1, 2.0])
def test_images_follow_at_any_rate(graph, rate):
    graph.images.clear()
    graph.set(rate=rate, paused=False)
    reports = graph.reports(2.5)
    require_sound(reports)
    went = stamps(graph.images)
    assert (np.diff(went) > 0).all()
    played = min(rate * 2.5, POSES * STEP * 1e-9)  # s of the recording
    assert 0.5 * played < 1e-9 * (went[-1] - went[0]) <= 1.5 * played
    told = [Time.from_msg(each["stamp"]).nanoseconds - EPOCH for each in reports["probe_tracker"]]
    assert 0 <= told[-1] <= 1e9 * played + 1e9  # stamped with the recording's time


@pytest.mark.slow
def test_nothing_ages_while_the_clock_stands(graph):
    graph.set(paused=False)
    graph.bench.spin_until(lambda: len(graph.images) > 20)
    graph.set(paused=True)
    graph.spin_for(3.0)  # until a busy machine has drawn what it still had
    count = len(graph.images)
    require_sound(graph.reports(2.5))  # longer than a probe is lost after
    assert len(graph.images) == count
    assert graph.imager.health.values["probe_pose"] == "live"
    graph.set(paused=False)
    graph.bench.spin_until(lambda: len(graph.images) > count + 20)


@pytest.mark.slow
@pytest.mark.parametrize("back", [0.3, 2.0])  # s: less and more than a late pose may be late
def test_the_graph_goes_along_when_the_clock_jumps_back(graph, back):
    graph.set(paused=False, time=3.2, rate=0.1)  # a busy machine must not miss the jump
    graph.bench.spin_until(lambda: stamps(graph.images)[-1] > 3.3e9)
    sought = stamps(graph.images)[-1] - 1e9 * back
    graph.set(time=1e-9 * sought)
    graph.bench.spin_until(lambda: (np.diff(stamps(graph.images)) < 0).any())
    graph.images.clear()
    graph.bench.spin_until(lambda: len(graph.images) > 20)
    assert (np.diff(stamps(graph.images)) > 0).all()
    require_sound(graph.reports(2.5))
    assert not graph.tracker.health.problems["order"]


def test_a_recorder_begins_when_simulated_time_does(bench, tmp_path):
    file = tmp_path / "session.mcap"
    recorder = bench.make(SessionRecorder, file=str(file), use_sim_time=True, topics=["/said"])
    said = bench.peer.create_publisher(String, "said", 10)
    bench.spin_for(30)
    assert not said.get_subscription_count()
    clocks = bench.publisher(Clock, "/clock")
    clocks.publish(Clock(clock=stamp_message(EPOCH)))
    bench.spin_until(said.get_subscription_count)
    said.publish(String(data="yes"))
    bench.spin_until(lambda: recorder.health.received)
    recorder.stop_recording()
    assert [message.log_time for message in read_bag(file).read_messages()] == [EPOCH]


def test_a_player_that_follows_a_clock_goes_on_when_that_is_set_back(bench, tmp_path):
    bag = path_of(tmp_path)
    poses = bench.collect(PoseStamped, "tracker/pose")
    player = bench.make(PathPlayer, path=str(bag), use_sim_time=True)
    clocks = bench.publisher(Clock, "/clock")
    bench.spin_for(60)
    assert not poses  # time has not begun
    now = EPOCH

    def tick(until, step=STEP):
        nonlocal now
        while len(poses) < until:
            now += step
            clocks.publish(Clock(clock=stamp_message(now)))
            bench.spin_for(2)

    tick(50)
    now -= 10**10
    tick(100)
    depths = np.array([pose.pose.position.z for pose in poses])
    np.testing.assert_allclose(depths, DEPTHS[: len(depths)], atol=1e-12)
    assert not player.finished.done()
