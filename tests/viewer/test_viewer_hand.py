"""On which surface the viewer puts the probe, whatever comes of it and in which order.

The hand in the viewer: what it publishes, from when on, until when, and what it refuses.
"""

import math
from concurrent.futures import Future

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Int32MultiArray

from us_sim.errors import MessageError
from us_sim.geometry.pose import Pose
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import cloud_message, mesh_message, pose_message, tetrahedra_message
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.nodes.qos import LATCHED
from us_sim.recording.decoding import nanoseconds_of
from us_sim.skin.surface import bent_surface, plane_surface
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.viewer.feeds import RestMeshListener
from us_sim.viewer.hand import PatientSurface, ViewerHand
from us_sim.viewer.hand_command import HandCommand
from us_sim.viewer.parameters import Parameter, ParameterKind
from us_sim.viewer.session import SessionBoard, SessionState
from us_sim.viewer.stream import CallPoster, Feed, PageSources


class Stander(GuardedNode):
    """A node that knows a surface."""

    def __init__(self, **kwargs):
        super().__init__("stander", **kwargs)
        self.health = Health(self, "test")
        self.surface = PatientSurface(self, RestMeshListener(self))
        self.surface.follow_meshes(True)


@pytest.fixture
def stander(bench):
    return bench.make(Stander)


def offer_skin(bench, height):
    sheet = plane_surface((0.1, 0.1), 0.02)
    publisher = bench.peer.create_publisher(Mesh, "skin/mesh", LATCHED)
    publisher.publish(mesh_message(np.add(sheet.vertices, [0, 0, height]), sheet.triangles))
    return publisher


def offer_tissue(bench, top):
    sides = ((-0.03, 0.03), (-0.02, 0.02), (top, top + 0.04))
    mesh = box_mesh(*(uniform_planes(*side, 4) for side in sides))
    rest = bench.peer.create_publisher(PointCloud2, "tissue/rest", LATCHED)
    corners = bench.peer.create_publisher(Int32MultiArray, "tissue/tetrahedra", LATCHED)
    columns = dict(zip("xyz", mesh.nodes.T, strict=True))
    rest.publish(cloud_message(columns, Time(), "patient"))
    corners.publish(tetrahedra_message(mesh.tetrahedra))
    return rest, corners


def height(stander):
    best = stander.surface.find_surface()
    return None if best is None else best.find_top(0.0, 0.0).point[2]


def test_without_anything_it_is_the_plane(stander):
    assert height(stander) == 0.0


def test_the_upper_side_of_the_tissue(bench, stander):
    offer_tissue(bench, 0.012)
    bench.spin_until(lambda: height(stander) == pytest.approx(0.012))
    surface = stander.surface.find_surface()
    np.testing.assert_allclose(surface.lower, [-0.03, -0.02, 0.012], atol=1e-6)
    np.testing.assert_allclose(surface.upper, [0.03, 0.02, 0.012], atol=1e-6)
    np.testing.assert_allclose(surface.find_top(0.0, 0.0).normal, [0, 0, -1], atol=1e-9)


def test_the_skin_goes_before_the_tissue(bench, stander):
    offer_tissue(bench, 0.012)
    skin = offer_skin(bench, 0.01)
    bench.spin_until(lambda: height(stander) == pytest.approx(0.01))
    bench.peer.destroy_publisher(skin)  # another scene, without
    bench.spin_until(lambda: height(stander) == pytest.approx(0.012))


def test_what_is_offered_is_awaited(bench, stander):
    bench.peer.create_publisher(Mesh, "skin/mesh", LATCHED)
    bench.spin_until(lambda: stander.surface.find_surface() is None)


def test_a_skin_that_is_none_is_refused_and_said(bench, stander):
    publisher = bench.peer.create_publisher(Mesh, "skin/mesh", LATCHED)
    publisher.publish(mesh_message(np.zeros((3, 3)), np.array([[0, 1, 2]])))
    bench.spin_until(lambda: stander.health.problems["mesh"] == 1)
    assert "no triangle with an area" in stander.health._last_problem


class Holder(GuardedNode):
    """A node with the hand of a viewer, and no web server."""

    def __init__(self, **kwargs):
        super().__init__("viewer", **kwargs)
        self.health = Health(self, "test")
        self.post = CallPoster(self)
        self.sources = PageSources()
        self.hand = ViewerHand(self, self.post, self.sources, RestMeshListener(self))


class Page:
    """A page, which asks the hand."""

    def __init__(self, bench, holder):
        self._bench, self._holder = bench, holder
        self.feed, self._sequence = holder.hand.feed, 0

    def __call__(self, **wish):
        self._sequence += 1
        asked = {"source": "page", "sequence": self._sequence, **wish}
        return self._holder.sources.commands["hand"](asked, 1)

    def open(self):
        self.feed.add_watcher(self.nothing)

    def close(self):
        self.feed.remove_watcher(self.nothing)

    def nothing(self) -> None:
        """It is told nothing."""

    @property
    def state(self):
        packet = self.feed.get_newest()
        return packet.header if packet else {"leader": "unknown", "obstacle": "unknown"}

    def await_leader(self, name):
        self._bench.spin_until(lambda: self.state["leader"] == name)


@pytest.fixture
def page(bench):
    return Page(bench, bench.make(Holder))


@pytest.fixture
def tracked(bench):
    """Poses that the probe's tracker publishes."""
    tracker = bench.tracker = bench.make(ProbeTracker)
    poses = bench.collect(PoseStamped, "probe/pose")
    bench.spin_until(lambda: tracker.count_subscribers("probe/pose") > 0)
    return poses


def depth(pose):
    return pose.pose.position.z


def test_without_a_page_nothing_is_published(bench, page, tracked):
    topic = "tracker/pose"
    bench.spin_for(10)
    assert bench.peer.count_publishers(topic) == 0
    page.open()
    bench.spin_until(lambda: len(tracked) > 2)
    page.close()
    bench.spin_until(lambda: bench.peer.count_publishers(topic) == 0)
    count = len(tracked)
    bench.spin_for(30)
    assert len(tracked) == count


def test_it_begins_on_the_skin_and_repeats_the_pose_at_rest(bench, page, tracked):
    page.open()
    bench.spin_until(lambda: len(tracked) >= 4)
    assert depth(tracked[0]) == pytest.approx(0.001)
    gaps = np.diff([nanoseconds_of(pose.header.stamp) for pose in tracked]) * 1e-9
    assert np.median(gaps) > 0.15
    assert {pose.header.frame_id for pose in tracked} == {"patient"}


def test_while_blood_or_time_is_watched_the_resting_probe_is_imaged_as_if_it_moved(
    bench, page, tracked
):
    page.open()
    bench.spin_until(lambda: len(tracked) >= 2 and page.state.get("is_resting"))
    sources = page._holder.sources
    overlay = Parameter("slice_interpolator", "overlay", ParameterKind.TEXT, "velocity")
    sources.nodes.get_node("slice_interpolator").parameters = {"overlay": overlay}
    for kind in ("m_mode", "spectrum", "annotated"):
        sources.add_feeds(Feed(kind))
        sources.feeds[kind].add_watcher(page.nothing)
        bench.spin_until(lambda: not page.state["is_resting"])
        sources.feeds[kind].remove_watcher(page.nothing)
        bench.spin_until(lambda: page.state["is_resting"])


def test_a_press_ends_where_it_was_wanted(bench, page, tracked):
    page.open()
    page.await_leader("hand")
    bench.spin_until(lambda: len(tracked) >= 1)
    for press in (0.003, 0.006, 0.009):
        assert page(to={"press": press}) is None
        bench.spin_until(lambda end=press: depth(tracked[-1]) == pytest.approx(end, abs=1e-5))
    depths = np.array([depth(pose) for pose in tracked])
    stamps = np.array([nanoseconds_of(pose.header.stamp) for pose in tracked]) * 1e-9
    assert (np.diff(depths) >= -1e-9).all()  # never back
    assert depths.max() <= 0.009 + 1e-9  # never beyond
    assert (np.diff(depths) <= 0.15 * np.maximum(np.diff(stamps), 1 / 60) * 1.2).all()


def test_the_pose_that_contains_a_wish_is_known_by_its_stamp(bench, page, tracked):
    hand = page._holder.hand
    page.open()
    page.await_leader("hand")
    bench.spin_until(lambda: len(tracked) >= 1)
    first = nanoseconds_of(tracked[-1].header.stamp)
    assert hand.describe_pose(first, None)["command"] is None
    page(by={"slide": [0.002, 0.0]})
    page(by={"slide": [0.003, 0.0]})
    bench.spin_until(lambda: tracked[-1].pose.position.x == pytest.approx(0.005, abs=1e-5))
    facts = [hand.describe_pose(nanoseconds_of(pose.header.stamp), None) for pose in tracked]
    answers = [each["command"] for each in facts]
    assert answers[-1] == ("page", 2)
    moved = [a for a, pose in zip(answers, tracked, strict=True) if pose.pose.position.x > 1e-6]
    assert moved[0] is not None
    assert [each["press"] for each in facts] == pytest.approx([depth(pose) for pose in tracked])
    assert hand.describe_pose(7, None)["press"] is None
    of_others = hand.describe_pose(7, [0.01, 0.0, 0.004])
    assert of_others["press"] == pytest.approx(0.004)


@pytest.mark.usefixtures("tracked")
def test_the_first_page_that_moves_the_probe_holds_it_until_it_goes_or_another_takes_over(
    bench, page
):
    sources = page._holder.sources

    def other(connection, **wish):
        asked = {"source": "other", "sequence": 1, **wish}
        return sources.commands["hand"](asked, connection)

    def held_by(holder):
        bench.spin_until(lambda: page.state["holder"] == holder)

    page.open()
    page.await_leader("hand")
    held_by("")
    assert page(by={"press": 0.001}) is None
    held_by("page")
    bench.spin_until(lambda: page.state["goal"]["press"] == pytest.approx(0.002))
    assert other(2, to={"x": 0.037}).startswith("another page holds the probe: Take over")
    bench.spin_for(5)
    assert page.state["goal"]["x"] == 0.0
    assert sources.commands["take"]("other", 2) is None
    held_by("other")
    assert "Take over" in page(by={"press": 0.001})
    for leave in sources.leaving:
        leave(1)  # which is not the holder
    bench.spin_for(5)
    held_by("other")
    for leave in sources.leaving:
        leave(2)
    held_by("")
    assert other(3) is None  # it comes back, and holds what nobody holds
    held_by("other")


def test_the_probe_stands_on_the_skin_along_its_normal(bench, page, tracked):
    radius = 0.045
    arm = bent_surface((0.1, 0.06), 0.002, flat_width=0.0, radius=radius)
    publisher = bench.peer.create_publisher(Mesh, "skin/mesh", LATCHED)
    publisher.publish(mesh_message(arm.vertices, arm.triangles))
    page.open()
    page.await_leader("hand")
    side = [radius * math.sin(0.7), 0.01, radius * (1 - math.cos(0.7))]
    above = [1.2 * side[0], side[1], 1.2 * side[2] - 0.2 * radius]
    assert page(to={"point": above, "press": 0.0}) is None
    bench.spin_until(lambda: page.state["stance"]["x"] == pytest.approx(side[0], abs=2e-3))
    bench.spin_until(lambda: page.state["stance"]["press"] == pytest.approx(0.0, abs=1e-5))
    bench.spin_until(lambda: page.state["stance"] == pytest.approx(page.state["goal"], abs=1e-4))
    bench.spin_for(5)
    last = tracked[-1].pose
    orientation = [getattr(last.orientation, axis) for axis in "xyzw"]
    inwards = Pose([last.position.x, last.position.y, last.position.z], orientation).rotation[:, 2]
    angle = np.arctan2(last.position.x, radius - last.position.z)
    np.testing.assert_allclose(inwards, [-np.sin(angle), 0, np.cos(angle)], atol=0.01)
    assert np.hypot(last.position.x, radius - last.position.z) == pytest.approx(radius, abs=5e-5)
    assert page.state["range"]["y"] == pytest.approx([-0.03, 0.03])


def test_somebody_else_leads_as_long_as_he_publishes(bench, page, tracked):
    page.open()
    page.await_leader("hand")
    driver = bench.peer.create_publisher(PoseStamped, "tracker/pose", 10)
    page.await_leader("bench")
    assert "bench moves the probe" in page(by={"press": 0.001})
    assert bench.peer.count_publishers("tracker/pose") == 1
    now = bench.peer.get_clock().now

    def has_followed():
        driver.publish(pose_message(Pose([0.013, 0.0, 0.004]), now().to_msg(), "patient"))
        return page.state["stance"]["x"] == pytest.approx(0.013)

    bench.spin_until(has_followed)
    assert page.state["stance"]["press"] == pytest.approx(0.004)
    bench.peer.destroy_publisher(driver)
    page.await_leader("hand")
    bench.spin_until(lambda: tracked[-1].pose.position.x == pytest.approx(0.013, abs=1e-6))
    assert depth(tracked[-1]) == pytest.approx(0.004, abs=1e-6)


def test_who_comes_when_nobody_moves_the_probe_begins_where_it_is(bench, page, tracked):
    driver = bench.peer.create_publisher(PoseStamped, "tracker/pose", 10)
    now = bench.peer.get_clock().now
    place = Pose([0.013, 0.0, 0.004])

    def has_followed():
        driver.publish(pose_message(place, now().to_msg(), "patient"))
        return bool(tracked)

    bench.spin_until(has_followed)
    bench.peer.destroy_publisher(driver)  # as a viewer that is killed
    count = len(tracked)
    page.open()
    page.await_leader("hand")
    bench.spin_until(lambda: len(tracked) > count + 2)
    positions = [[p.pose.position.x, p.pose.position.z] for p in tracked[count:]]
    np.testing.assert_allclose(positions, [[0.013, 0.004]] * len(positions), atol=1e-6)


@pytest.mark.usefixtures("tracked")
def test_a_replay_is_ended_on_request_and_nothing_else_is(bench, page):
    holder, asked = page._holder, []
    done = Future()
    done.set_result("")
    board = SessionBoard(send=lambda values: asked.append(values) or done)
    holder.sources.session = board
    take = holder.sources.commands["take"]
    page.open()
    page.await_leader("hand")
    assert take("page", 1) is None
    board.state = SessionState(is_there=True, replay="/somewhere/press.mcap")
    driver = bench.peer.create_publisher(PoseStamped, "tracker/pose", 10)
    page.await_leader("bench")
    assert "bench moves the probe" in take("page", 1)
    assert not page.state["can_take"]
    assert asked == []
    bench.peer.destroy_publisher(driver)
    player = bench.add(GuardedNode("path_player", context=bench.context))
    player.create_publisher(PoseStamped, "tracker/pose", 10)
    page.await_leader("path_player")
    assert page.state["can_take"]
    assert "the replay of press.mcap moves the probe" in page.state["obstacle"]
    assert take("page", 1) is None
    assert asked == [{"replay": ""}]
    bench.spin_until(lambda: page.state["holder"] == "page")


def test_no_tracker_that_listens_is_said(bench, page):
    page.open()
    page.await_leader("nobody")
    assert page(go="home") == "no simulator with a probe runs yet"
    bench.peer.create_publisher(PoseStamped, "probe/pose", 10)
    page.await_leader("tracker")
    assert "follows the scene's own tracker" in page(go="home")


def test_a_simulator_that_does_not_follow_is_said(bench, page, tracked, monkeypatch):
    monkeypatch.setattr("us_sim.viewer.hand.UNANSWERED", 0.5)
    page.open()
    bench.spin_until(lambda: len(tracked) > 2)
    assert page.state["warning"] == ""
    bench.executor.remove_node(bench.tracker)  # as one that hangs
    bench.spin_until(lambda: "does not answer" in page.state["warning"])
    bench.executor.add_node(bench.tracker)
    bench.spin_until(lambda: page.state["warning"] == "")


@pytest.mark.parametrize(
    ("wish", "said"),
    [
        ([1], "command"),
        ({"sequence": 1}, "source"),
        ({"source": "a", "sequence": True}, "sequence"),
        ({"source": "a", "sequence": 1, "go": "away"}, "upright"),
        ({"source": "a", "sequence": 1, "to": {"press": float("nan")}}, "press"),
        ({"source": "a", "sequence": 1, "to": {"press": 10**400}}, "press"),
        ({"source": "a", "sequence": 1, "to": {"press": 1e4}}, "10 m"),
        ({"source": "a", "sequence": 1, "to": {"point": [1, 2]}}, "point"),
        ({"source": "a", "sequence": 1, "by": {"slide": "left"}}, "slide"),
        ({"source": "a", "sequence": 1, "by": {"point": [0, 0, 0]}}, "by"),
    ],
)
def test_what_is_no_command_is_refused(wish, said):
    with pytest.raises(MessageError, match=said):
        HandCommand.read(wish)
