"""The monitor counts over restarts, sees other runs, and reports what was lost."""

from array import array

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.parameter import Parameter

from us_sim.nodes.session_monitor import TOLD, SessionMonitor


def report(name, **values):
    """A node's report."""
    pairs = [KeyValue(key=key.replace("_", " "), value=value) for key, value in values.items()]
    return DiagnosticArray(status=[DiagnosticStatus(name=name, message="running", values=pairs)])


def test_counts_go_on_over_restarts_and_strangers_are_not_kept(bench):
    monitor = bench.add(SessionMonitor(["imager"], context=bench.context))
    publisher = bench.publisher(DiagnosticArray, "diagnostics")
    for message in (
        report("/imager", pid="7", published_images="90"),
        report("/imager", pid="7", published_images="100"),
        report("/imager", pid="8", published_images="5"),
        report("/imager", pid="9" * 5000, published_images="-3"),
        report("/stranger", pid="9", published_images="1000"),
    ):
        publisher.publish(message)
    bench.spin_until(lambda: sum(monitor.heard.values()) == 4)
    assert monitor.count("imager", "images") == 105
    assert monitor.heard == {("imager", 7): 2, ("imager", 8): 1, ("imager", 0): 1}
    assert set(monitor.reports) == {"imager"}


def test_what_is_set_of_nodes_that_it_follows_is_told_once(bench):
    monitor = bench.add(SessionMonitor(["imager"], context=bench.context))
    for name in ("imager", "stranger"):
        node = bench.add(Node(name, context=bench.context))
        node.declare_parameters("", [("gain", 1.0), ("gains", [0.0]), ("texts", [""])])
        bench.spin_until(lambda node=node: node.count_subscribers("/parameter_events"))
        values = {"gain": 3.0, "gains": array("d", [1.0, 2.0]), "texts": ["a"]}
        node.set_parameters([Parameter(key, value=value) for key, value in values.items()])
    bench.spin_until(lambda: len(monitor._set.get("imager", {})) == 3)
    assert monitor.take_set() == {"imager": {"gain": 3.0, "gains": [1.0, 2.0], "texts": ["a"]}}
    assert monitor.take_set() == {}


def test_two_runs_see_each_other(bench):
    runs = ["00000000000000000001 left 10", "00000000000000000002 right 11"]
    monitors = [bench.add(SessionMonitor([], run, context=bench.context)) for run in runs]
    monitors.append(bench.add(SessionMonitor(context=bench.context)))  # of `us-sim play`
    bench.spin_until(lambda: set(runs) <= monitors[2].other_runs)
    bench.spin_until(lambda: runs[1] in monitors[0].other_runs)
    bench.spin_until(lambda: runs[0] in monitors[1].other_runs)
    for run, monitor in zip(runs, monitors, strict=False):
        assert run not in monitor.other_runs
        assert "" not in monitor.other_runs


def test_what_was_lost_is_reported_at_once_and_the_newest_last(bench):
    reports = bench.collect(DiagnosticArray, "diagnostics")
    monitor = bench.add(SessionMonitor(context=bench.context))
    publisher = monitor.health._publisher
    bench.spin_until(lambda: publisher.get_subscription_count() > 1)
    reports.clear()
    monitor.tell_lost([f"loss {k}" for k in range(1, TOLD + 11)])
    bench.spin_until(lambda: reports)
    (status,) = reports[0].status
    told = {item.key: item.value for item in status.values}
    assert status.level == DiagnosticStatus.WARN
    assert status.message == told[f"lost {TOLD + 10}"] == f"loss {TOLD + 10}"
    assert told["lost"] == str(TOLD + 10)
    assert "lost 10" not in told
    assert told["lost 11"] == "loss 11"
