"""A node goes on whatever comes in: bad input is refused, a failure counted, said and survived."""

import threading
import time
from pathlib import Path

import pytest
from bench import pose_at
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.task import Future
from std_srvs.srv import Trigger

from us_sim.errors import PoseError
from us_sim.nodes import guarded_node, process
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.nodes.qos import SENT


class Broken(GuardedNode):
    """A node with health, whose callbacks fail as long as they are told to."""

    def __init__(self, **kwargs):
        super().__init__("broken", **kwargs)
        self.health = Health(self, "test")
        self.error = None
        self.calls = 0

    def work(self, *_):
        self.calls += 1
        if self.error is not None:
            raise self.error


@pytest.fixture
def broken(bench):
    return bench.make(Broken)


@pytest.fixture
def said(broken, monkeypatch):
    lines = []
    log = broken.get_logger()
    for level in ("error", "warning", "debug"):
        monkeypatch.setattr(
            type(log), level, lambda _, text, level=level, **__: lines.append((level, text))
        )
    return lines


def test_a_failing_subscription_is_counted_said_ever_more_rarely_and_goes_on(bench, broken, said):
    broken.subscribe(PoseStamped, "pose", broken.work, SENT)
    reports = bench.collect(DiagnosticArray, "diagnostics")
    poses = bench.publisher(PoseStamped, "pose")
    broken.error = ValueError("a\nbug")
    for second in range(1, 31):
        poses.publish(pose_at(0.0, second))
    bench.spin_until(lambda: broken.calls == 30)
    assert broken.failures == {"/pose": 30}
    assert broken.last_failure == "/pose: ValueError: a bug"
    errors = [text for level, text in said if level == "error"]
    assert errors[0].startswith("/pose: ValueError: a bug; the node goes on")
    assert len(errors) <= 3  # a slow machine may take some seconds for all
    traces = [text for level, text in said if level == "debug" and "Traceback" in text]
    assert len(traces) == len(errors)
    assert "raise self.error" in traces[0]

    def level():
        return [r.status[0].level for r in reports if r.status[0].message == broken.last_failure]

    bench.spin_until(level)
    assert level() == [DiagnosticStatus.ERROR]

    def counted():
        values = {item.key: item.value for item in reports[-1].status[0].values}
        return values["failed /pose"] == "30"

    bench.spin_until(counted)
    broken.error = None
    poses.publish(pose_at(0.0, 31))
    bench.spin_until(lambda: broken.calls == 31)
    assert broken.failures.total() == 30


def test_bad_input_is_refused_by_its_kind_and_is_no_failure(bench, broken):
    broken.subscribe(PoseStamped, "pose", broken.work)
    poses = bench.publisher(PoseStamped, "pose")
    broken.error = PoseError("it is nowhere")
    poses.publish(pose_at(0.0, 1))
    bench.spin_until(lambda: broken.health.problems["pose"] == 1)
    assert not broken.failures


def test_what_is_said_is_one_line_however_a_message_is_quoted(broken):
    broken.report_bad_input("/pose", PoseError("in frame '\x1b[2J\n" + "a" * 10_000))
    broken.report_failure("/pose", ValueError("\x07\n" * 10_000))
    for sentence in (broken.health._last_problem, broken.last_failure):
        assert sentence.startswith("/pose: ")
        assert sentence.isprintable()
        assert len(sentence) < 600


def test_timers_and_calls_from_threads_go_on(bench, broken):
    broken.error = RuntimeError("a bug")
    broken.create_timer(0.01, broken.work)
    bench.spin_until(lambda: broken.failures["timer Broken.work"] >= 3)
    for count in (1, 2):
        threading.Thread(target=broken.call_soon, args=(broken.work,)).start()
        bench.spin_until(lambda count=count: broken.failures["Broken.work"] == count)


def test_a_clock_that_does_not_come_is_said(bench, monkeypatch):
    monkeypatch.setattr(guarded_node, "CLOCK_S", 0.05)
    said = []
    monkeypatch.setattr(
        type(bench.peer.get_logger()), "warning", lambda _, text, **__: said.append(text)
    )
    bench.make(Broken, use_sim_time=True)
    bench.spin_until(lambda: said)
    assert "/clock" in said[0]


def test_an_answer_does_not_say_that_what_failed_was_done(bench, broken):
    broken.error = RuntimeError("a bug")
    broken.create_command("pull", broken.work)
    client = bench.peer.create_client(Trigger, "broken/pull")
    bench.spin_until(client.service_is_ready)
    answer = client.call_async(Trigger.Request())
    bench.spin_until(answer.done)
    assert (answer.result().success, answer.result().message) == (False, guarded_node.FAILED)


def test_what_ends_a_node_still_does(broken):
    for ending in (KeyboardInterrupt, ExternalShutdownException, SystemExit):
        broken.error = ending()
        with pytest.raises(ending):
            broken.guard_callback("here", broken.work)()
    assert not broken.failures


def test_a_source_that_fails_is_reset_and_goes_on(bench, small_scene, tmp_path, monkeypatch):
    scene = tmp_path / "haptic.yaml"
    scene.write_text(f"{small_scene.read_text()}\ntracker: {{source: haptic}}\n")
    node = bench.make(ProbeTracker, scene=str(scene), lockstep=True)
    poses = bench.collect(PoseStamped, "probe/pose")
    publisher = bench.publisher(PoseStamped, "haptic/pose")
    handle = node._input._handle
    handle.set_clutch(True)
    with monkeypatch.context() as patched:
        patched.setattr(handle, "measure_body", None)
        publisher.publish(pose_at(0.001, 1))
        bench.spin_until(lambda: node.failures["/haptic/pose"] == 1)
    assert not handle.is_held
    for second in range(2, 302):
        publisher.publish(pose_at(0.001, second))
        bench.spin_for(1)
    bench.spin_until(lambda: len(poses) == 300)


def test_latency_counts_from_arrival_where_stamps_are_of_another_clock(broken, said):
    monotonic = time.monotonic_ns()
    now = broken.get_clock().now().nanoseconds
    for age, expected in ((0.02, 20.0), (95_332_936.7, 5.0), (95_332_936.8, 5.0), (-3600.0, 5.0)):
        broken.arrived = monotonic - 5_000_000
        nanoseconds = now - round(1e9 * age)
        broken.health.count_published(
            "out", Time(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        )
        late = 1e-6 * (time.monotonic_ns() - monotonic)
        assert expected - 1.0 < broken.health._latencies[-1] < expected + late + 5.0
    (warning,) = (text for level, text in said if level == "warning")
    assert "95332936.7 s old, so they are of another clock" in warning


def test_stamps_of_a_clock_that_goes_ahead_are_told(bench, broken):
    reports = bench.collect(DiagnosticArray, "diagnostics")
    ahead = broken.get_clock().now().nanoseconds + 2 * 10**9
    broken.health.count_published("out", Time(sec=ahead // 10**9, nanosec=ahead % 10**9))
    broken.health.publish_report()
    bench.spin_until(lambda: any("ahead" in each.status[0].message for each in reports))
    status = reports[-1].status[0]
    assert status.level == DiagnosticStatus.WARN
    told = float(status.message.split(" ms ahead")[0].rsplit(" ", 1)[1])
    assert 1000.0 < told <= 2000.0


class Failing:
    """An executor whose first turns raise what rclpy does for what it cannot decode."""

    def __init__(self, node, turns):
        self._executor, self._turns = process.create_executor(node), turns

    def spin_once(self, timeout_sec):
        self._turns -= 1
        if self._turns >= 0:
            raise RuntimeError("failed to take request")
        self._executor.spin_once(timeout_sec)

    def remove_node(self, node):
        self._executor.remove_node(node)


def test_spinning_survives_what_rclpy_raises(bench, broken):
    bench.executor.remove_node(broken)
    broken.finished = Future()
    broken.create_timer(0.01, lambda: broken.finished.set_result(None))
    process.spin(broken, Failing(broken, 3))
    assert broken.failures == {"what came in": 3}


def test_timers_that_are_overdue_at_the_start_keep_their_periods(bench, broken):
    bench.executor.remove_node(broken)
    timers = [broken.create_timer(0.05, lambda: None) for _ in range(3)]
    time.sleep(0.06)
    executor = process.create_executor(broken)
    for _ in range(10):
        executor.spin_once(timeout_sec=0.0)
    assert max(timer.time_until_next_call() for timer in timers) <= 0.05e9
    executor.remove_node(broken)


def test_every_node_and_every_subscription_is_guarded():
    package = Path(guarded_node.__file__).parents[1]
    files = (file for file in package.rglob("*.py") if package / "evaluation" not in file.parents)
    texts = {file: file.read_text("utf-8") for file in files}
    own = {"guarded_node", "recorded_topic"}
    assert {file.stem for file, text in texts.items() if "(Node):" in text} == {"guarded_node"}
    assert {file.stem for file, text in texts.items() if ".create_subscription(" in text} == own


class Consumer(Broken):
    """A node to which more comes while it works: how many by its turns."""

    def __init__(self, more, lockstep=False, **kwargs):
        super().__init__(**kwargs)
        self.more, self.lockstep, self.worked, self.sent = more, lockstep, [], 1
        self.subscribe(PoseStamped, "pose", self.work, newest=True)

    def work(self, message):
        self.worked.append(message.header.stamp.sec)
        for _ in range(self.more.pop(0) if self.more else 0):
            self.sent += 1
            self.sender.publish(pose_at(0.0, self.sent))


@pytest.mark.parametrize(
    ("more", "lockstep", "worked"),
    [([8], False, [1, 9]), ([8], True, [*range(1, 10)]), ([3, 40], False, [1, 4, 44])],
)
def test_the_newest_is_worked_on_and_what_is_skipped_counted(bench, more, lockstep, worked):
    """Also what a queue of ten has overwritten; in lockstep all are worked on."""
    node = bench.add(Consumer(more, lockstep, context=bench.context))
    node.sender = bench.publisher(PoseStamped, "pose")
    node.sender.publish(pose_at(0.0, 1))
    bench.spin_until(lambda: node.worked[-1:] == worked[-1:])
    bench.spin_for(5)
    assert node.worked == worked
    assert node.health.dropped == node.sent - len(worked)


def test_the_level_of_a_report_says_whether_the_node_does_its_work(bench, broken):
    reports = bench.collect(DiagnosticArray, "diagnostics")

    def report():
        count = len(reports)
        broken.health.publish_report()
        bench.spin_until(lambda: len(reports) > count)
        return reports[-1].status[0].level, reports[-1].status[0].message

    bench.spin_until(lambda: reports)
    broken.health.state = "working"
    assert report() == (DiagnosticStatus.OK, "working")
    broken.health.count_problem("pose", "a pose was no pose")
    assert report() == (DiagnosticStatus.WARN, "a pose was no pose")
    assert report() == (DiagnosticStatus.OK, "working")
    broken.health.warning = "the newest pose is old"
    broken.health.fault = "there is no device"
    assert report() == (DiagnosticStatus.ERROR, "there is no device")
    broken.health.fault = ""
    assert report() == (DiagnosticStatus.WARN, "the newest pose is old")
