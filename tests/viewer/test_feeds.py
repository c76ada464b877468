"""Topics that stream to pages: subscribed to while watched, decoded when taken, or refused.

What the 3D scene of a page gets of a graph: rest once, then what moves; and what is refused.
"""

from collections.abc import Callable
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from bench import Bench, pose_at
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, WrenchStamped
from sensor_msgs.msg import Image, PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Float64MultiArray, Int32MultiArray
from visualization_msgs.msg import MarkerArray

from us_sim.geometry.collider import RoundedBox
from us_sim.geometry.transducer import build_transducer_mesh
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import (
    MarkerShape,
    affine_message,
    cloud_message,
    image_message,
    mesh_message,
    serialize_markers,
    tetrahedra_message,
    wrench_message,
)
from us_sim.nodes.qos import LATCHED
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.viewer.feeds import (
    ProbeFeeds,
    RestMeshListener,
    SkinFeeds,
    StructuresFeed,
    TissueFeeds,
    make_image_feeds,
)
from us_sim.viewer.stream import CallPoster, Feed, Packet


class Watcher(GuardedNode):
    """A node with the feeds of a viewer, and no web server."""

    def __init__(self, **kwargs):
        super().__init__("watcher", **kwargs)
        self.health = Health(self, "test")
        self.post = CallPoster(self)
        self.arranged = False, False
        feeds = make_image_feeds(
            self, self.post, 30.0, lambda stamp: {"known": stamp}, lambda: self.arranged
        )
        self.feeds = {feed.kind: feed for feed in feeds}


@pytest.fixture
def watcher(bench):
    return bench.make(Watcher)


def nothing() -> None:
    """Who watches is told nothing."""


def speckle(*shape: int):
    return np.random.default_rng(2).integers(0, 256, shape, dtype=np.uint8)


def test_watching_on_and_off_at_once_ends_as_it_was_left(bench, watcher):
    publisher = bench.peer.create_publisher(Image, "ultrasound/image", 10)
    feed = watcher.feeds["image"]
    for _ in range(3):
        feed.add_watcher(nothing)
        feed.remove_watcher(nothing)
    feed.add_watcher(nothing)
    bench.spin_until(lambda: publisher.get_subscription_count() == 1)
    bench.spin_for(5)
    assert publisher.get_subscription_count() == 1


@pytest.mark.parametrize(
    ("kind", "topic"),
    [
        ("annotated", "ultrasound/image_annotated"),
        ("spectrum", "ultrasound/spectrum"),
    ],
)
def test_pictures_keep_their_colours(bench, watcher, kind, topic):
    feed, picture = watcher.feeds[kind], np.zeros((48, 64, 3), np.uint8)
    picture[:, :32] = 200, 60, 30  # red
    feed.add_watcher(nothing)
    publisher = bench.publisher(Image, topic)
    publisher.publish(image_message(picture, Time(), "probe"))
    bench.spin_until(lambda: feed.sequence == 1)
    decoded = cv2.imdecode(np.frombuffer(feed.get_newest().payload, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(decoded[24, 10].astype(int) - (30, 60, 200)).max() <= 6
    assert decoded[24, 55].max() <= 6


def test_a_jpeg_of_speckle_is_near_what_it_was(bench, watcher):
    feed = watcher.feeds["image_jpeg"]
    smooth = cv2.GaussianBlur(speckle(256, 256), (0, 0), 2.0)
    feed.add_watcher(nothing)
    publisher = bench.publisher(Image, "ultrasound/image")
    publisher.publish(image_message(smooth, Time(), "probe"))
    bench.spin_until(lambda: feed.sequence == 1)
    packet = feed.get_newest()
    decoded = cv2.imdecode(np.frombuffer(packet.payload, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(decoded.astype(int) - smooth).mean() < 1.5
    assert len(packet.payload) < 0.5 * smooth.size


def test_an_image_says_where_its_pixels_are_and_what_else_is_known(bench, watcher):
    matrix = np.array([[1e-4, 0, 0, -0.02], [0, 0, 1, 0], [0, 2e-4, 0, 1e-4], [0, 0, 0, 1.0]])
    places = bench.peer.create_publisher(Float64MultiArray, "ultrasound/image_to_probe", LATCHED)
    places.publish(affine_message(matrix))
    feed = watcher.feeds["image"]
    feed.add_watcher(nothing)
    publisher = bench.publisher(Image, "ultrasound/image")

    pixels = speckle(40, 30)

    def newest():
        publisher.publish(image_message(pixels, Time(sec=7), "probe"))
        packet = feed.get_newest()
        return packet if packet and "matrix" in packet.header else None

    packet = bench.spin_until(newest) or newest()
    assert packet.header["matrix"] == matrix.ravel().tolist()
    assert packet.header["known"] == 7 * 10**9
    watcher.arranged, last = (True, True), feed.sequence
    bench.spin_until(lambda: newest() and feed.sequence > last)
    packet = newest()
    shown = np.frombuffer(packet.payload, np.uint8).reshape(40, 30)
    np.testing.assert_array_equal(shown, pixels[:, ::-1])
    flipped = np.reshape(packet.header["matrix"], (4, 4))
    for column, row in ((0, 0), (29, 3)):
        there, here = flipped @ [29 - column, row, 0, 1], matrix @ [column, row, 0, 1]
        np.testing.assert_allclose(there, here, atol=1e-15)


@pytest.mark.parametrize(
    ("kind", "message", "sentence"),
    [
        ("image", {"encoding": "rgb8"}, "must be mono8"),
        ("image_jpeg", {"width": 0}, "0 pixels"),
        ("annotated", {"encoding": "mono8"}, "must be rgb8"),
    ],
)
def test_what_cannot_be_shown_is_said_and_the_next_is_shown(
    bench, watcher, kind, message, sentence
):
    feed = watcher.feeds[kind]
    feed.add_watcher(nothing)
    topic = "ultrasound/image_annotated" if kind == "annotated" else "ultrasound/image"
    publisher = bench.publisher(Image, topic)
    odd = image_message(speckle(4, 4), Time(), "probe")
    for name, value in message.items():
        setattr(odd, name, value)
    publisher.publish(odd)
    bench.spin_until(lambda: feed.sequence == 1)
    assert feed.get_newest() is None
    assert watcher.health.problems["volume"] == 1
    assert sentence in watcher.health._last_problem
    good = speckle(4, 4, 3)
    sound = image_message(good, Time(), "probe") if kind == "annotated" else None
    publisher.publish(sound or image_message(good[..., 0], Time(), "probe"))
    bench.spin_until(lambda: feed.sequence == 2)
    assert feed.get_newest() is not None


def test_posted_work_is_done_in_order_and_a_failure_is_said(bench):
    node = GuardedNode("late", context=bench.context)
    post, done = CallPoster(node), []
    post(lambda: 1 // 0)
    for i in range(3):  # before anybody spins the node
        post(lambda i=i: done.append(i))
    bench.add(node)
    post(lambda: done.append(3))
    bench.spin_until(lambda: done == [0, 1, 2, 3])
    assert "ZeroDivisionError" in node.last_failure


def test_of_two_images_beside_each_other_the_left_ones_pixels_are_known(bench, watcher):
    matrix = np.array([[1e-4, 0, 0, -0.02], [0, 0, 1, 0], [0, 2e-4, 0, 1e-4], [0, 0, 0, 1.0]])
    places = bench.peer.create_publisher(Float64MultiArray, "ultrasound/image_to_probe", LATCHED)
    places.publish(affine_message(matrix))
    watcher.arranged = True, True
    feed = watcher.feeds["annotated"]
    feed.add_watcher(nothing)
    publisher = bench.publisher(Image, "ultrasound/image_annotated")

    def header():
        message = image_message(np.zeros((40, 60, 3), np.uint8), Time(), "probe")
        publisher.publish(message)
        packet = feed.get_newest()
        return packet.header if packet and "matrix" in packet.header else None

    bench.spin_until(header)
    there = np.reshape(header()["matrix"], (4, 4)) @ [29, 3, 0, 1]
    np.testing.assert_allclose(there, matrix @ [0, 3, 0, 1], atol=1e-15)


PLANES = uniform_planes(-0.02, 0.02, 4)
MESH = box_mesh(PLANES, PLANES, PLANES)
SQUARE = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
SMALL = np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]])
CLOSED = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def cloud(points: np.ndarray, second: int = 0) -> PointCloud2:
    columns = dict(zip("xyz", points.T, strict=True))
    return cloud_message(columns, Time(sec=second), "patient")


def unused() -> None:
    """Do nothing: a page that is told of something new takes it when it is ready."""


@pytest.fixture
def graph(bench: Bench) -> SimpleNamespace:
    """A node with all feeds of the scene, by kind, and publishers to it."""
    node = bench.add(GuardedNode("viewer", context=bench.context))
    node.health = Health(node, "test")
    post = CallPoster(node)
    feeds: dict[str, Feed] = {}
    rest = RestMeshListener(node)
    probe = ProbeFeeds(node, post, 30.0)
    for made in (SkinFeeds(node, post, 30.0), probe):
        feeds |= {feed.kind: feed for feed in made.feeds}
    feeds |= {feed.kind: feed for feed in TissueFeeds(node, post, 30.0, rest).feeds}
    structures = StructuresFeed(node, post, rest)
    feeds["structures"] = structures.feed

    def newest(kind: str, when: Callable[[Packet], bool] = lambda _: True) -> Packet:
        found: list[Packet] = []

        def look() -> bool:
            packet = feeds[kind].get_newest()
            found[:] = [packet] if packet is not None and when(packet) else []
            return bool(found)

        bench.spin_until(look)
        return found[0]

    def latch(kind: type, topic: str, message: object) -> None:
        publisher = bench.peer.create_publisher(kind, topic, LATCHED)
        publisher.publish(message)
        kept.append(publisher)

    kept: list[object] = []
    told = {"feeds": feeds, "newest": newest, "latch": latch, "probe": probe}
    told["structures"] = structures
    return SimpleNamespace(bench=bench, node=node, **told)


def test_nothing_is_subscribed_to_while_no_page_watches(graph):
    topics = ["skin/nodes", "tissue/nodes", "tissue/structures", "probe/pose", "probe/marker"]
    graph.bench.spin_for(5)
    assert not any(graph.bench.peer.count_subscribers(topic) for topic in topics)
    for feed in graph.feeds.values():
        feed.add_watcher(unused)
    graph.bench.spin_until(lambda: graph.bench.peer.count_subscribers("skin/nodes") == 1)
    for feed in graph.feeds.values():
        feed.remove_watcher(unused)
    graph.bench.spin_until(
        lambda: not any(graph.bench.peer.count_subscribers(topic) for topic in topics)
    )


def test_the_skin_is_told_once_and_moved_by_steps(graph):
    graph.latch(Mesh, "skin/mesh", mesh_message(SQUARE, TRIANGLES))
    for kind in ("skin_mesh", "skin"):
        graph.feeds[kind].add_watcher(unused)
    told = graph.newest("skin_mesh")
    nodes = graph.bench.publisher(PointCloud2, "skin/nodes")
    nodes.publish(cloud(SQUARE + np.array([0, 0, 0.003]), second=7))
    moved = graph.newest("skin")
    steps = np.frombuffer(moved.payload, np.int16).reshape(-1, 3)
    np.testing.assert_allclose(steps * moved.header["resolution"], [[0, 0, 0.003]] * 4, atol=5e-7)
    assert moved.header["mesh"] == told.header["mesh"]
    assert moved.header["stamp"] == str(7 * 10**9)


def test_skin_that_cannot_be_used_is_said_and_what_was_there_stays(graph):
    graph.latch(Mesh, "skin/mesh", mesh_message(SQUARE, TRIANGLES))
    for kind in ("skin_mesh", "skin"):
        graph.feeds[kind].add_watcher(unused)
    graph.newest("skin_mesh")
    nodes = graph.bench.publisher(PointCloud2, "skin/nodes")
    for wrong in (SQUARE[:3], SQUARE * np.nan):
        before = graph.node.health.problems["mesh"]
        sequence = graph.feeds["skin"].sequence
        nodes.publish(cloud(wrong))
        graph.bench.spin_until(lambda s=sequence: graph.feeds["skin"].sequence > s)
        assert graph.feeds["skin"].get_newest() is None
        assert graph.node.health.problems["mesh"] == before + 1
    nodes.publish(cloud(SQUARE))
    assert graph.newest("skin").header["points"] == 4


def test_tissue_comes_with_its_outer_faces_and_strain_when_asked_for(graph):
    graph.latch(PointCloud2, "tissue/rest", cloud(MESH.nodes))
    graph.latch(Int32MultiArray, "tissue/tetrahedra", tetrahedra_message(MESH.tetrahedra))
    for kind in ("tissue_mesh", "tissue", "strain"):
        graph.feeds[kind].add_watcher(unused)
    told = graph.newest("tissue_mesh")
    assert told.header["points"] == len(MESH.nodes) == 64
    assert told.header["triangles"] == 6 * 9 * 2
    assert told.header["edges"] == 3 * 54  # of a closed surface 3/2 of the triangles
    nodes = graph.bench.publisher(PointCloud2, "tissue/nodes")
    graph.bench.spin_until(lambda: graph.bench.peer.count_subscribers("tissue/nodes") == 2)
    across = 1.02**-0.5
    nodes.publish(cloud(MESH.nodes * [across, across, 1.02], second=1))
    moved = graph.newest("tissue")
    steps = np.frombuffer(moved.payload, np.int16).reshape(-1, 3) * moved.header["resolution"]
    np.testing.assert_allclose(steps[:, 2], 0.02 * MESH.nodes[:, 2], atol=1e-6)
    strain = np.frombuffer(graph.newest("strain").payload, np.float32)
    assert strain == pytest.approx(0.02, rel=0.02)


def test_tetrahedra_of_nodes_that_there_are_not_are_refused(graph):
    graph.latch(PointCloud2, "tissue/rest", cloud(MESH.nodes))
    huge = MESH.tetrahedra.copy()
    huge[3, 2] = 2**30
    graph.latch(Int32MultiArray, "tissue/tetrahedra", tetrahedra_message(huge))
    graph.feeds["tissue_mesh"].add_watcher(unused)
    graph.bench.spin_until(lambda: graph.node.health.problems["mesh"] > 0)
    assert graph.feeds["tissue_mesh"].get_newest() is None


def test_structures_are_heard_once_and_carried_from_then_on(graph):
    graph.latch(PointCloud2, "tissue/rest", cloud(MESH.nodes))
    graph.latch(Int32MultiArray, "tissue/tetrahedra", tetrahedra_message(MESH.tetrahedra))
    graph.feeds["structures"].add_watcher(unused)
    markers = graph.bench.publisher(MarkerArray, "tissue/structures")
    nodes = graph.bench.publisher(PointCloud2, "tissue/nodes")
    deformed = MESH.nodes + np.array([0, 0, 0.002])
    corners = (SMALL + np.array([0, 0, 0.002]))[CLOSED.ravel()]
    vein = MarkerShape("vein", (0.2, 0.4, 0.8, 1.0), corners)
    nodes.publish(cloud(deformed, second=4))
    nodes.publish(cloud(deformed, second=5))
    markers.publish(serialize_markers([vein], Time(sec=5), "patient"))
    packet = graph.newest("structures")
    count = packet.header["vertices"]
    nodes_of = np.frombuffer(packet.payload, np.uint32, 4 * count).reshape(-1, 4)
    weights = np.frombuffer(packet.payload, np.float32, 4 * count, 16 * count).reshape(-1, 4)
    at_rest = np.einsum("va,vax->vx", weights, MESH.nodes[nodes_of])
    np.testing.assert_allclose(np.sort(at_rest, axis=0), np.sort(SMALL, axis=0), atol=1e-7)
    assert packet.header["parts"][0]["name"] == "vein"
    graph.bench.spin_until(lambda: graph.bench.peer.count_subscribers("tissue/structures") == 0)
    assert graph.bench.peer.count_subscribers("tissue/nodes") == 0
    graph.structures.forget_structures()  # another scene has the same mesh
    assert graph.feeds["structures"].get_newest() is None
    graph.bench.spin_until(lambda: graph.bench.peer.count_subscribers("tissue/structures") == 1)


def test_the_probe_comes_with_its_shape_its_pose_and_its_force(graph):
    parts = build_transducer_mesh(
        RoundedBox(length=0.046, width=0.014, height=0.04, rounding=0.004)
    )
    shapes = [MarkerShape(p.name, (*p.colour, 1.0), p.vertices[p.triangles.ravel()]) for p in parts]
    outline = np.array([[-0.02, 0, 0], [0.02, 0, 0], [0.02, 0, 0.04], [-0.02, 0, 0.04]])
    shapes.append(MarkerShape("image", (1.0,) * 4, np.concatenate([outline, outline[:1]]), 4e-4))
    graph.latch(MarkerArray, "probe/marker", serialize_markers(shapes, Time(), "probe"))
    for kind in ("probe_mesh", "probe"):
        graph.feeds[kind].add_watcher(unused)
    told = graph.newest("probe_mesh")
    by_name = {part["name"]: part for part in told.header["parts"]}
    assert [by_name[p.name]["triangles"] for p in parts] == [len(p.triangles) for p in parts]
    assert [by_name[p.name]["vertices"] for p in parts] == [len(p.vertices) for p in parts]
    assert told.header["outline"] == 4
    last = np.frombuffer(told.payload, np.float32)[-12:].reshape(4, 3)
    np.testing.assert_allclose(last, outline, atol=1e-9)
    poses = graph.bench.publisher(PoseStamped, "probe/pose")
    wrenches = graph.bench.publisher(WrenchStamped, "probe/wrench")
    poses.publish(pose_at(0.012, second=9))
    assert graph.newest("probe").header["position"] == [0.0, 0.0, 0.012]
    force = np.array([0.0, 0.5, -3.0])
    wrenches.publish(wrench_message(force, np.zeros(3), Time(sec=9), "probe"))
    packet = graph.newest("probe", lambda packet: "force" in packet.header)
    assert packet.header["force"] == [0.0, 0.5, -3.0]
    assert packet.header["stamp"] == str(9 * 10**9)
    assert packet.header["force_age"] == 0.0
    poses.publish(pose_at(0.012, second=11))  # without a force
    packet = graph.newest("probe", lambda packet: packet.header["stamp"] == str(11 * 10**9))
    assert packet.header["force_age"] == 2.0
    of_nine = graph.probe.find_pose_and_wrench(str(9 * 10**9))
    assert (of_nine["position"][2], of_nine["force"]) == (0.012, [0.0, 0.5, -3.0])
    assert "force" not in graph.probe.find_pose_and_wrench(str(11 * 10**9))
    assert graph.probe.find_pose_and_wrench("7") == {}
