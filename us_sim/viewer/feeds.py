"""A topic that is subscribed to while a page watches what is made of it.

Surfaces that come as markers, each triangle with corners of its own.

The tissue's mesh at rest, which comes in two latched messages.

The images of ``ultrasound/…``, as pixels or as JPEG, with what is known of each.

The probe: its shape once, and where it is with the force that it feels.

The skin: its triangles once, and where its vertices are.

The tissue: its outer faces and all its nodes, and how much it is strained.

Vessels, nerves and bones: heard once, and then carried by the tissue's nodes.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Float64MultiArray, Int32MultiArray
from visualization_msgs.msg import MarkerArray

from us_sim.errors import MeshError, VolumeError
from us_sim.nodes.guarded_node import GuardedNode, decoded
from us_sim.nodes.messages import (
    affine_from,
    colour_pixels_from,
    line_from,
    markers_stamp,
    mesh_from,
    nanoseconds_of,
    pixels_from,
    pose_from,
    tetrahedra_from,
    triangles_from,
    vectors_from,
    wrench_from,
)
from us_sim.nodes.posted import Posted
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.slicing.settings import STRIPS
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.stream import Feed, Packet
from us_sim.viewer.surfaces import (
    CarriedSurfaces,
    ColouredSurface,
    EquivalentStrain,
    RestSurface,
    transducer_packet,
    welded,
)

Make = Callable[[Any, int], Packet]
MakeOrWait = Callable[[Any, int], Packet | None]


def made_of(
    node: GuardedNode, message_type: Any, topic: str, data: bytes, make: Callable[[Any], Any]
) -> Any:
    """What ``make`` makes of a message's bytes; None, and said by the node, where it refuses it."""
    made: list[Any] = []
    take = decoded(message_type, lambda message: made.append(make(message)))
    node.guarded(node.resolve_topic_name(topic), take)(data)
    return made[0] if made else None


class WatchedTopic:
    """Feeds a stream with the messages of a topic.

    What comes is kept as bytes; only what a page takes is decoded and made into a packet, in the
    page's thread. What cannot be used is said by the node.

    Args:
        node: that subscribes.
        post: has work done in the node's thread.
        message_type: of the topic.
        topic: its name.
        make: the packet of a message and a number, or None while there is none to be made; what
            it raises refuses the message.
        kind: the stream's name.
        rate: Hz, at most, for each page; None is all.
        qos: of the subscription.
    """

    def __init__(
        self,
        node: GuardedNode,
        post: Posted,
        message_type: Any,
        topic: str,
        make: MakeOrWait,
        kind: str,
        rate: float | None,
        qos: QoSProfile = STREAM,
    ) -> None:
        self.feed = Feed(kind, lambda _: post(self._subscribe), rate)
        self._node = node
        self._type, self._topic, self._qos = message_type, topic, qos
        self._make = make
        self._subscription: Any = None

    def _subscribe(self) -> None:
        """As it is now: it may have changed again since."""
        if self.feed.is_watched and self._subscription is None:
            self._subscription = self._node.create_subscription(
                self._type, self._topic, self._take, self._qos, raw=True
            )
        elif not self.feed.is_watched and self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _take(self, data: bytes) -> None:
        def pack(sequence: int) -> Packet | None:
            packet: Packet | None = made_of(
                self._node,
                self._type,
                self._topic,
                data,
                lambda message: self._make(message, sequence),
            )
            return packet

        self.feed.offer(pack)


def surfaces_of(message: MarkerArray, frame: str) -> list[ColouredSurface]:
    """Of each namespace one, with shared vertices.

    Raises:
        MeshError: the corners do not make whole triangles, or one is not finite.
        MessageError: a marker is in another frame.
    """
    surfaces = []
    for name, colour, corners in triangles_from(message, frame):
        vertices, triangles = welded(corners)
        if len(triangles):
            surfaces.append(ColouredSurface(name, colour, vertices, triangles))
    return surfaces


class RestMesh:
    """``tissue/rest`` and ``tissue/tetrahedra``, subscribed to while somebody watches them.

    One serves all who work with the mesh, in the node's thread.

    Args:
        node: that subscribes.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._watchers: list[Callable[[], None]] = []
        self._subscriptions: list[Any] = []
        self._rest: PointCloud2 | None = None
        self._tetrahedra: Int32MultiArray | None = None
        self.mesh: TetrahedralMesh | None = None
        self.surface: RestSurface | None = None  # its outer faces, with their edges

    def watch(self, came: Callable[[], None], is_wanted: bool = True) -> None:
        """Have ``came`` called when there is another mesh, or no longer.

        The mesh that is there is kept, and nobody is called for it.
        """
        if is_wanted == (came in self._watchers):
            return
        if is_wanted:
            self._watchers.append(came)
        else:
            self._watchers.remove(came)
        if bool(self._watchers) == bool(self._subscriptions):
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        if self._watchers:
            self._subscriptions = [
                self._node.create_subscription(
                    PointCloud2, "tissue/rest", self._take_rest, LATCHED
                ),
                self._node.create_subscription(
                    Int32MultiArray, "tissue/tetrahedra", self._take_tetrahedra, LATCHED
                ),
            ]

    def _take_rest(self, message: PointCloud2) -> None:
        self._rest = message
        self._make(is_complete=False)

    def _take_tetrahedra(self, message: Int32MultiArray) -> None:
        self._tetrahedra = message
        self._make(is_complete=True)

    def _make(self, is_complete: bool) -> None:
        """Of the two a mesh, unless the second has still to follow the first of another scene."""
        if self._rest is None or self._tetrahedra is None:
            return
        nodes = vectors_from(self._rest, "patient")
        tetrahedra = tetrahedra_from(self._tetrahedra)
        if tetrahedra.max(initial=-1) + 1 != len(nodes):
            if not is_complete:
                return
            raise MeshError(
                f"the tissue has {len(nodes)} nodes at rest, and its tetrahedra name "
                f"{tetrahedra.max(initial=-1) + 1}: the two are not of the same mesh"
            )
        mesh = TetrahedralMesh(nodes, tetrahedra)
        surface = RestSurface.around(mesh)
        if self.surface is not None and surface.number == self.surface.number:
            return
        self.mesh, self.surface = mesh, surface
        for came in list(self._watchers):
            self._node.guarded(self._node.resolve_topic_name("tissue/rest"), came)()


_QUALITY = 90
"""Of JPEG: 512 × 512 pixels of speckle are 60 kB then, a quarter of what they were."""

Known = Callable[[int], dict[str, Any]]


def image_feeds(
    node: GuardedNode,
    post: Posted,
    rate: float,
    known: Known = lambda _: {},
    arranged: Callable[[], tuple[bool, bool]] = lambda: (False, False),
) -> list[Feed]:
    """The B-mode image as ``image`` and ``image_jpeg``, and pictures in colour.

    The header of a B-mode image, and of the annotated one, says where its pixels are (``matrix``).

    Args:
        node: that subscribes.
        post: has work done in the node's thread.
        rate: Hz, of images, at most, for each page.
        known: what else is known of the image of a stamp, ns, for its header.
        arranged: whether left and right are to be exchanged, as in the annotated image, and
            whether that has the B-mode image at its left.
    """
    places: list[NDArray[np.float64]] = []

    def place(message: Float64MultiArray) -> None:
        places[:] = [affine_from(message)]

    node.create_subscription(Float64MultiArray, "ultrasound/image_to_probe", place, LATCHED)

    def telling(make: Callable[[Image, int, bool], Packet]) -> Make:
        def tell(message: Image, sequence: int) -> Packet:
            flip, is_beside = arranged()
            packet = make(message, sequence, flip)
            header = {**packet.header, **known(int(packet.header["stamp"]))}
            panels = 2 if is_beside and packet.kind == "annotated" else 1
            if panels > 1:
                header["panels"] = panels
            for matrix in places:
                columns = int(header["columns"]) // panels
                of_pixels = _flipped(matrix, columns) if flip else matrix
                header["matrix"] = of_pixels.ravel().tolist()
            return replace(packet, header=header)

        return tell

    def images(topic: str, kind: str, make: Make) -> Feed:
        return WatchedTopic(node, post, Image, topic, make, kind, rate).feed

    annotated = _colour_jpeg("annotated")
    return [
        images("ultrasound/image", "image", telling(_pixels)),
        images("ultrasound/image", "image_jpeg", telling(_grey_jpeg)),
        images("ultrasound/image_annotated", "annotated", telling(lambda m, n, _: annotated(m, n))),
        *(images(strip.topic, kind, _colour_jpeg(kind)) for kind, strip in STRIPS.items()),
    ]


def _pixels(message: Image, sequence: int, flip: bool) -> Packet:
    return Packet("image", sequence, _header(message, "mono8"), _grey(message, flip).tobytes())


def _grey_jpeg(message: Image, sequence: int, flip: bool) -> Packet:
    return _jpeg(message, "image_jpeg", sequence, _grey(message, flip))


def _grey(message: Image, flip: bool) -> NDArray[np.uint8]:
    pixels = pixels_from(message)
    return np.ascontiguousarray(pixels[:, ::-1] if flip else pixels)


def _flipped(matrix: NDArray[np.float64], columns: int) -> NDArray[np.float64]:
    """From (column, row, 0, 1) of the image whose left and right are exchanged."""
    exchange = np.diag([-1.0, 1.0, 1.0, 1.0])
    exchange[0, 3] = columns - 1
    return matrix @ exchange


def _colour_jpeg(kind: str) -> Make:
    def make(message: Image, sequence: int) -> Packet:
        pixels = cv2.cvtColor(colour_pixels_from(message), cv2.COLOR_RGB2BGR)
        return _jpeg(message, kind, sequence, pixels)

    return make


def _jpeg(message: Image, kind: str, sequence: int, pixels: NDArray[Any]) -> Packet:
    done, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise VolumeError("the image cannot be made a JPEG")
    return Packet(kind, sequence, _header(message, "jpeg"), encoded.tobytes())


def _header(message: Image, encoding: str) -> dict[str, Any]:
    stamp = str(nanoseconds_of(message.header.stamp))  # more digits than a number of JavaScript
    rows, columns = int(message.height), int(message.width)
    return {"stamp": stamp, "rows": rows, "columns": columns, "encoding": encoding}


_POSE, _WRENCH = "probe/pose", "probe/wrench"
_KEPT = 16
"""Poses and wrenches, until the image of their stamp is made."""


class ProbeFeeds:
    """The streams ``probe_mesh``, of ``probe/marker``, and ``probe``, of pose and wrench."""

    def __init__(self, node: GuardedNode, post: Posted, rate: float) -> None:
        told = WatchedTopic(
            node, post, MarkerArray, "probe/marker", _tell, "probe_mesh", None, LATCHED
        )
        self._node = node
        self._feed = Feed("probe", lambda _: post(self._listen), rate)
        self._subscriptions: list[Any] = []
        self._poses: deque[bytes] = deque(maxlen=_KEPT)
        self._wrenches: deque[bytes] = deque(maxlen=_KEPT)
        self.feeds: list[Feed] = [told.feed, self._feed]

    def _listen(self) -> None:
        if self._feed.is_watched == bool(self._subscriptions):
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        if self._feed.is_watched:
            self._wrenches.clear()  # of the time before
            self._subscriptions = [
                self._node.create_subscription(PoseStamped, _POSE, self._move, STREAM, raw=True),
                self._node.create_subscription(
                    WrenchStamped, _WRENCH, self._push, STREAM, raw=True
                ),
            ]

    def _move(self, data: bytes) -> None:
        self._poses.append(data)
        self._offer()

    def _push(self, data: bytes) -> None:
        self._wrenches.append(data)
        self._offer()

    def _offer(self) -> None:
        if self._poses:
            wrench = self._wrenches[-1] if self._wrenches else None
            self._feed.offer(partial(self._pack, self._poses[-1], wrench))

    def at(self, stamp: str) -> dict[str, Any]:
        """Position, quaternion, force and torque of a stamp, ns, as far as they are known.

        While nobody watches the stream ``probe`` nothing is.
        """
        kinds: list[tuple[Any, str, deque[bytes], Callable[[Any], dict[str, Any]], str]] = [
            (PoseStamped, _POSE, self._poses, _posed, "stamp"),
            (WrenchStamped, _WRENCH, self._wrenches, _pushed, "force_stamp"),
        ]
        found: dict[str, Any] = {}
        for kind, topic, kept, make, key in kinds:
            headers = (made_of(self._node, kind, topic, each, make) for each in reversed([*kept]))
            found |= next((each for each in headers if each and each[key] == stamp), {})
        return found

    def _pack(self, pose: bytes, wrench: bytes | None, sequence: int) -> Packet | None:
        header = made_of(self._node, PoseStamped, _POSE, pose, _posed)
        if header is None:
            return None
        pushed = wrench and made_of(self._node, WrenchStamped, _WRENCH, wrench, _pushed)
        if pushed:
            age = 1e-9 * (int(header["stamp"]) - int(pushed["force_stamp"]))
            header |= pushed | {"force_age": round(age, 3)}
        return Packet("probe", sequence, header, b"")


def _tell(message: MarkerArray, sequence: int) -> Packet:
    parts = surfaces_of(message, "probe")
    return transducer_packet("probe_mesh", sequence, parts, line_from(message, "probe"))


def _posed(message: PoseStamped) -> dict[str, Any]:
    pose = pose_from(message, "patient")
    return {
        "stamp": str(nanoseconds_of(message.header.stamp)),
        "position": pose.position.tolist(),
        "quaternion": pose.orientation.tolist(),
    }


def _pushed(message: WrenchStamped) -> dict[str, Any]:
    wrench = wrench_from(message, "probe")
    return {
        "force": wrench[:3].tolist(),
        "torque": wrench[3:].tolist(),
        "force_stamp": str(nanoseconds_of(message.header.stamp)),
    }


class SkinFeeds:
    """The streams ``skin_mesh``, of ``skin/mesh``, and ``skin``, of ``skin/nodes``."""

    def __init__(self, node: GuardedNode, post: Posted, rate: float) -> None:
        self._surface: RestSurface | None = None
        told = WatchedTopic(node, post, Mesh, "skin/mesh", self._tell, "skin_mesh", None, LATCHED)
        moved = WatchedTopic(node, post, PointCloud2, "skin/nodes", self._move, "skin", rate)
        self.feeds: list[Feed] = [told.feed, moved.feed]

    def _tell(self, message: Mesh, sequence: int) -> Packet:
        self._surface = RestSurface(*mesh_from(message))
        return self._surface.told("skin_mesh", sequence)

    def _move(self, message: PointCloud2, sequence: int) -> Packet | None:
        if self._surface is None:
            return None
        positions = vectors_from(message, "patient")
        stamp = nanoseconds_of(message.header.stamp)
        return self._surface.moved(positions, kind="skin", sequence=sequence, stamp=stamp)


_STRAIN_RATE = 12.0
"""Hz: strain takes longer than positions, and its colours are read and not followed."""


class TissueFeeds:
    """The streams ``tissue_mesh``, ``tissue`` and ``strain``, of ``tissue/…``."""

    def __init__(self, node: GuardedNode, post: Posted, rate: float, rest: RestMesh) -> None:
        self._rest = rest
        self._number: int | None = None  # of the mesh that was told
        self._strain: tuple[TetrahedralMesh, EquivalentStrain] | None = None
        self._told = Feed("tissue_mesh", lambda _: post(self._listen), rate=None)
        topic = "tissue/nodes"
        moved = WatchedTopic(node, post, PointCloud2, topic, self._move, "tissue", rate)
        strained = WatchedTopic(
            node, post, PointCloud2, topic, self._be_strained, "strain", min(rate, _STRAIN_RATE)
        )
        self.feeds: list[Feed] = [self._told, moved.feed, strained.feed]

    def _listen(self) -> None:
        """Hear of meshes while a page watches; one may be there already."""
        self._rest.watch(self._offer, self._told.is_watched)
        self._offer()

    def _offer(self) -> None:
        surface = self._rest.surface
        if surface is not None and surface.number != self._number:
            self._number = surface.number
            self._told.offer(lambda sequence: surface.told("tissue_mesh", sequence))

    def _move(self, message: PointCloud2, sequence: int) -> Packet | None:
        surface = self._rest.surface
        if surface is None:
            return None
        positions = vectors_from(message, "patient")
        stamp = nanoseconds_of(message.header.stamp)
        return surface.moved(positions, kind="tissue", sequence=sequence, stamp=stamp)

    def _be_strained(self, message: PointCloud2, sequence: int) -> Packet | None:
        mesh, surface = self._rest.mesh, self._rest.surface
        if mesh is None or surface is None:
            return None
        if self._strain is None or self._strain[0] is not mesh:
            self._strain = mesh, EquivalentStrain(mesh)
        nodes = vectors_from(message, "patient")
        if nodes.shape != mesh.nodes.shape:
            raise MeshError(f"{len(nodes)} nodes came, and the mesh has {len(mesh.nodes)}")
        header = {
            "stamp": str(nanoseconds_of(message.header.stamp)),
            "mesh": surface.number,
            "points": len(nodes),
        }
        values = self._strain[1].of(nodes).astype(np.float32)
        return Packet("strain", sequence, header, values.tobytes())


_REMEMBERED = 32
_NODES, _STRUCTURES = "tissue/nodes", "tissue/structures"


class StructuresFeed:
    """The stream ``structures``, of ``tissue/structures``.

    That is three megabytes a message, twenty times a second. So it is listened to until one
    message has come whose stamp is also one of ``tissue/nodes``; then it is known where in the
    tissue each vertex lies, and the page moves the structures with the tissue.
    """

    def __init__(self, node: GuardedNode, post: Posted, rest: RestMesh) -> None:
        self._node = node
        self._rest = rest
        self.feed = Feed("structures", lambda _: post(self._listen), rate=None)
        self._post = post
        self._subscriptions: list[Any] = []
        self._nodes: dict[int, bytes] = {}  # by stamp, ns
        self._structures: tuple[int, bytes] | None = None
        self._made_for: int | None = None  # the number of the mesh
        self._making: threading.Thread | None = None

    def _listen(self) -> None:
        """Hear what is wanted now: the mesh while watched, and the rest until it has been used."""
        self._rest.watch(self._listen, self.feed.is_watched)
        surface = self._rest.surface
        if surface is not None and surface.number != self._made_for:
            self.feed.forget()  # what was carried by the last mesh is of another scene
        wanted = (
            self.feed.is_watched
            and surface is not None
            and surface.number != self._made_for
            and self._making is None
        )
        if wanted == bool(self._subscriptions):
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        self._nodes.clear()
        self._structures = None
        if wanted:
            self._subscriptions = [
                self._node.create_subscription(kind, topic, take, STREAM, raw=True)
                for kind, topic, take in (
                    (PointCloud2, _NODES, self._take_nodes),
                    (MarkerArray, _STRUCTURES, self._take_structures),
                )
            ]

    def _take_nodes(self, data: bytes) -> None:
        message = made_of(self._node, PointCloud2, _NODES, data, lambda message: message)
        if message is None:
            return
        self._nodes[nanoseconds_of(message.header.stamp)] = data
        while len(self._nodes) > _REMEMBERED:
            del self._nodes[next(iter(self._nodes))]
        self._try()

    def _take_structures(self, data: bytes) -> None:
        stamp = markers_stamp(data)
        if stamp is not None:
            self._structures = stamp, data
            self._try()

    def _try(self) -> None:
        if self._structures is None or self._making is not None:
            return
        nodes = self._nodes.get(self._structures[0])
        mesh, surface = self._rest.mesh, self._rest.surface
        if nodes is None or mesh is None or surface is None:
            return
        self._making = threading.Thread(
            target=self._make,
            args=(mesh, surface.number, nodes, self._structures[1]),
            daemon=True,
            name="structures",
        )
        self._making.start()
        self._listen()

    def _make(self, mesh: TetrahedralMesh, number: int, nodes: bytes, structures: bytes) -> None:
        made = made_of(
            self._node,
            PointCloud2,
            _NODES,
            nodes,
            lambda message: TetrahedralMesh(vectors_from(message, "patient"), mesh.tetrahedra),
        )
        carried = None
        if made is not None:
            carried = made_of(
                self._node,
                MarkerArray,
                _STRUCTURES,
                structures,
                lambda message: _carried(message, made),
            )
        self._post(lambda: self._end(number, carried, is_wrong=made is not None))

    def _end(self, number: int, carried: CarriedSurfaces | None, is_wrong: bool) -> None:
        """Offer what was made. Structures that cannot be used are not tried again."""
        self._making = None
        if carried is not None or is_wrong:
            self._made_for = number
        surface = self._rest.surface
        if carried is not None and surface is not None and surface.number == number:
            self.feed.offer(lambda sequence: carried.told("structures", sequence, number))
        self._listen()


def _carried(message: MarkerArray, mesh: TetrahedralMesh) -> CarriedSurfaces:
    surfaces = surfaces_of(message, "patient")
    if not surfaces:
        raise MeshError("there is no triangle in it")
    return CarriedSurfaces(mesh, surfaces)
