"""The simulation's switches and its monitor: refusals, restarts, other runs, losses."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.parameter import Parameter

from us_sim.errors import SceneError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.session_control import SessionControl
from us_sim.nodes.session_monitor import TOLD, SessionMonitor
from us_sim.nodes.settings import SessionControlSettings
from us_sim.scene.listing import ListedScene
from us_sim.viewer.session import NOT_THERE, ViewerSession
from us_sim.viewer.stream import CallPoster


class Simulation:
    """Notes what it is told."""

    def __init__(self):
        self.taken = []

    def check(self, wanted, named):
        assert named
        if wanted.scene == "nowhere":
            raise SceneError("there is no scene file nowhere")

    def take(self, wanted, named):
        self.taken.append((set(named), wanted))


def controlled(bench):
    simulation = Simulation()
    settings = SessionControlSettings(scene="arm", volume="arm.nrrd")
    control = bench.add(
        SessionControl(simulation.check, simulation.take, settings, context=bench.context)
    )
    return control, simulation


def put(control, **values):
    parameters = [Parameter(name, value=value) for name, value in values.items()]
    return control.set_parameters_atomically(parameters)


def test_what_cannot_be_is_refused_and_stays_as_it_was(bench):
    control, simulation = controlled(bench)
    assert put(control, scene="nowhere").reason == "there is no scene file nowhere"
    assert "out of range" in put(control, replay_rate=0.0).reason
    assert not simulation.taken
    assert control.get_parameter("scene").value == "arm"


def test_a_volume_goes_with_the_scene_that_it_was_set_for(bench):
    control, simulation = controlled(bench)
    assert control.values.volume == "arm.nrrd"
    assert put(control, scene="leg").successful
    assert (control.values.scene, control.values.volume) == ("leg", None)
    assert control.get_parameter("volume").value == ""
    assert put(control, scene="arm", volume="other.nrrd").successful
    assert simulation.taken[-1][1].volume == "other.nrrd"


def test_the_same_value_again_is_told_too(bench):
    control, simulation = controlled(bench)
    for _ in range(2):
        assert put(control, replay_time=1.5).successful
    assert [named for named, _ in simulation.taken] == [{"replay_time"}] * 2


def test_what_is_so_is_shown_without_being_asked_for(bench):
    control, simulation = controlled(bench)
    control.set_state_parameters(SessionControlSettings(scene="leg", record="a.mcap"))
    assert control.get_parameter("record").value == "a.mcap"
    assert control.values.record == "a.mcap"
    assert not simulation.taken


def test_pages_follow_and_ask_and_hear_why_not(bench):
    control, simulation = controlled(bench)
    page = bench.add(GuardedNode("page", context=bench.context))
    session = ViewerSession(page, CallPoster(page))
    board = session
    assert board.ask_control(record="a.mcap").result() == NOT_THERE
    board.add_page()
    bench.spin_until(lambda: control.count_subscribers("session/scenes"))
    arm = ListedScene("arm", "/arm.yaml", description="An arm.", structures=("vein", "artery"))
    control.publish_scenes([arm, ListedScene("leg", "/leg.yaml", problem="volume: is missing")])
    control.publish_bags({"a.mcap": "/a.mcap"})
    values = {"scene": "arm", "replay_rate": "0.5", "replay_loop": "true", "fraction": "0.40"}
    values["record_note"] = "it lies beside another"
    control.publish_state("starting: 2 of 5 nodes", values, "nothing came")
    bench.spin_until(lambda: board.state.scene == "arm" and board.bags)
    bench.spin_until(lambda: board.scenes)
    assert [(each.description, each.problem) for each in board.scenes] == [
        ("An arm.", ""),
        ("", "volume: is missing"),
    ]
    assert [each.structures for each in board.scenes] == [("vein", "artery"), ()]
    assert (board.state.replay_rate, board.state.replay_loop, board.state.is_busy) == (
        0.5,
        True,
        True,
    )
    assert board.state.problem == "nothing came"
    assert board.state.record_note == "it lies beside another"
    bench.spin_until(lambda: session._client.services_are_ready())
    taken, refused = board.ask_control(record="b.mcap"), board.ask_control(scene="nowhere")
    bench.spin_until(lambda: taken.done() and refused.done())
    assert (taken.result(), refused.result()) == ("", "there is no scene file nowhere")
    assert simulation.taken[-1][1].record == "b.mcap"
    board.remove_page()
    bench.spin_until(lambda: not control.count_subscribers("session/scenes"))


def report(name, **values):
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
    assert monitor.count_messages("imager", "images") == 105
    assert monitor.heard == {("imager", 7): 2, ("imager", 8): 1, ("imager", 0): 1}
    assert set(monitor.reports) == {"imager"}


def test_what_was_lost_is_reported_at_once_and_the_newest_last(bench):
    reports = bench.collect(DiagnosticArray, "diagnostics")
    monitor = bench.add(SessionMonitor(context=bench.context))
    publisher = monitor.health._publisher
    bench.spin_until(lambda: publisher.get_subscription_count() > 1)
    reports.clear()
    monitor.report_losses([f"loss {k}" for k in range(1, TOLD + 11)])
    bench.spin_until(lambda: reports)
    (status,) = reports[0].status
    told = {item.key: item.value for item in status.values}
    assert status.level == DiagnosticStatus.WARN
    assert status.message == told[f"lost {TOLD + 10}"] == f"loss {TOLD + 10}"
    assert told["lost"] == str(TOLD + 10)
    assert "lost 10" not in told
    assert told["lost 11"] == "loss 11"
