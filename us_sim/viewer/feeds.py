"""Streams to the pages, from topics that the node subscribes to while a page watches them.

Messages stay bytes until a page takes them: then the page's thread decodes them and makes packets.
The node reports a message that cannot be used.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image, PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Float64MultiArray, Int32MultiArray
from visualization_msgs.msg import MarkerArray

from us_sim.errors import MeshError, VolumeError
from us_sim.nodes.guarded_node import GuardedNode, Subscriptions, keep_newest
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.recording.decoding import (
    affine_from,
    line_from,
    mesh_from,
    nanoseconds_of,
    pixels_from,
    pose_from,
    read_first_stamp,
    tetrahedra_from,
    triangles_from,
    vectors_from,
    wrench_from,
)
from us_sim.slicing.settings import STRIPS
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.stream import CallPoster, Feed, Packet
from us_sim.viewer.surfaces import (
    CarriedSurfaces,
    ColouredSurface,
    EquivalentStrain,
    StreamedSurface,
    make_transducer_packet,
    weld_corners,
)

_QUALITY = 90  # of JPEG: 512 × 512 pixels of speckle take 60 kB, a quarter of the raw image
_STRAIN_RATE = 12.0
"""Hz: strain takes longer to compute than positions, and the eye does not follow its colours."""
_NODES, _STRUCTURES = "tissue/nodes", "tissue/structures"
_UNIMAGED, _UNPAIRED = 16, 32  # poses and forces, and states of the tissue, that are kept

Make = Callable[[Any, int], Packet | None]
"""Makes a packet from a message and its sequence number; returns None while it cannot."""


def make_from_message(
    node: GuardedNode, message_type: Any, topic: str, data: bytes, make: Callable[[Any], Any]
) -> Any:
    """Decode a message and apply ``make``; report an error of either and return None."""

    def decode_and_make() -> Any:
        return make(deserialize_message(data, message_type))

    return node.guard_callback(node.resolve_topic_name(topic), decode_and_make)()


def make_topic_feed(
    node: GuardedNode,
    post: CallPoster,
    message_type: Any,
    topic: str,
    make: Make,
    kind: str,
    rate: float | None,
    qos: QoSProfile = STREAM,
) -> Feed:
    """Make the feed of one topic's messages.

    An error that ``make`` raises is reported. ``rate`` is the largest for each page, Hz; None sends
    every message.
    """

    def offer(data: bytes) -> None:
        feed.offer_packet(
            lambda n: make_from_message(node, message_type, topic, data, lambda m: make(m, n))
        )

    subscription = Subscriptions(node, (message_type, topic, offer, qos, True))
    # The call asks the feed again when it runs: the page may have gone meanwhile.
    feed = Feed(kind, lambda _: post(lambda: subscription.set_active(feed.is_watched)), rate)
    return feed


def make_image_feeds(
    node: GuardedNode,
    post: CallPoster,
    rate: float,
    known: Callable[[int], dict[str, Any]] = lambda _: {},
    arranged: Callable[[], tuple[bool, bool]] = lambda: (False, False),
) -> list[Feed]:
    """Make the feeds of the B-mode image, ``image`` and ``image_jpeg``, and of colour pictures.

    The headers of the B-mode image and of the annotated one have the places of the pixels as
    ``matrix``: (4, 4), row by row, from (column, row, 0, 1) to m in frame ``probe``.

    Args:
        node: the node that subscribes.
        post: runs calls in the node's thread.
        rate: Hz, largest rate of images for each page.
        known: returns more for the header of the image with a stamp, ns.
        arranged: returns whether left and right are exchanged, as in the annotated image, and
            whether the annotated image has the B-mode image at its left.
    """
    image_to_probe: NDArray[np.float64] | None = None

    def keep_matrix(message: Float64MultiArray) -> None:
        nonlocal image_to_probe
        image_to_probe = affine_from(message)

    node.subscribe(Float64MultiArray, "ultrasound/image_to_probe", keep_matrix, LATCHED)

    def add_header(make: Callable[[Image, int, bool], Packet]) -> Make:
        def make_with_header(message: Image, sequence: int) -> Packet:
            flip, is_beside = arranged()
            packet = make(message, sequence, flip)
            header = {**packet.header, **known(int(packet.header["stamp"]))}
            if image_to_probe is not None:
                images_abreast = 2 if is_beside and packet.kind == "annotated" else 1
                columns = int(header["columns"]) // images_abreast
                matrix = _flip_matrix(image_to_probe, columns) if flip else image_to_probe
                header["matrix"] = matrix.ravel().tolist()
            return replace(packet, header=header)

        return make_with_header

    def images(topic: str, kind: str, make: Make) -> Feed:
        return make_topic_feed(node, post, Image, topic, make, kind, rate)

    annotated = partial(_colour_jpeg, "annotated")
    return [
        images("ultrasound/image", "image", add_header(_make_raw)),
        images("ultrasound/image", "image_jpeg", add_header(_make_grey_jpeg)),
        images(
            "ultrasound/image_annotated", "annotated", add_header(lambda m, n, _: annotated(m, n))
        ),
        *(images(strip.topic, kind, partial(_colour_jpeg, kind)) for kind, strip in STRIPS.items()),
    ]


def _make_raw(message: Image, sequence: int, flip: bool) -> Packet:
    header = _make_image_header(message, "mono8")
    return Packet("image", sequence, header, _read_grey(message, flip).tobytes())


def _make_grey_jpeg(message: Image, sequence: int, flip: bool) -> Packet:
    return _make_jpeg(message, "image_jpeg", sequence, _read_grey(message, flip))


def _read_grey(message: Image, flip: bool) -> NDArray[np.uint8]:
    pixels = pixels_from(message)
    return np.ascontiguousarray(pixels[:, ::-1] if flip else pixels)


def _flip_matrix(matrix: NDArray[np.float64], columns: int) -> NDArray[np.float64]:
    """Return the matrix for the pixels of the image with left and right exchanged."""
    exchange = np.diag([-1.0, 1.0, 1.0, 1.0])
    exchange[0, 3] = columns - 1
    return matrix @ exchange


def _colour_jpeg(kind: str, message: Image, sequence: int) -> Packet:
    pixels = cv2.cvtColor(pixels_from(message, "rgb8"), cv2.COLOR_RGB2BGR)
    return _make_jpeg(message, kind, sequence, pixels)


def _make_jpeg(message: Image, kind: str, sequence: int, pixels: NDArray[Any]) -> Packet:
    done, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise VolumeError("the image cannot be made a JPEG")
    return Packet(kind, sequence, _make_image_header(message, "jpeg"), encoded.tobytes())


def _make_image_header(message: Image, encoding: str) -> dict[str, Any]:
    rows, columns = int(message.height), int(message.width)
    stamp = _format_stamp(message)
    return {"stamp": stamp, "rows": rows, "columns": columns, "encoding": encoding}


def _format_stamp(message: Any) -> str:
    """Return the stamp in ns as a text, as it has more digits than a number of JavaScript."""
    return str(nanoseconds_of(message.header.stamp))


def read_surfaces(message: MarkerArray, frame: str) -> list[ColouredSurface]:
    """Read one surface for each namespace, with shared vertices.

    Raises:
        MeshError: the corners do not make whole triangles, or one is not finite.
        MessageError: a marker is in another frame.
    """
    surfaces = []
    for name, colour, corners in triangles_from(message, frame):
        vertices, triangles = weld_corners(corners)
        if len(triangles):
            surfaces.append(ColouredSurface(name, colour, vertices, triangles))
    return surfaces


class ProbeFeeds:
    """The streams ``probe_mesh``, of ``probe/marker``, and ``probe``, of pose and wrench."""

    def __init__(self, node: GuardedNode, post: CallPoster, rate: float) -> None:
        self._feed = Feed("probe", lambda _: post(self._listen), rate)
        # By stamp, ns, until its image is made.
        self._poses: dict[str, dict[str, Any]] = {}
        self._forces: dict[str, dict[str, Any]] = {}
        self._subscriptions = Subscriptions(
            node,
            (PoseStamped, "probe/pose", self._on_pose, STREAM, False),
            (WrenchStamped, "probe/wrench", self._on_wrench, STREAM, False),
        )
        mesh = make_topic_feed(
            node, post, MarkerArray, "probe/marker", _make_probe_mesh, "probe_mesh", None, LATCHED
        )
        self.feeds: list[Feed] = [mesh, self._feed]

    def find_pose_and_wrench(self, stamp: str) -> dict[str, Any]:
        """Return position, quaternion, force and torque with a stamp (ns), as far as known.

        Nothing is known while no page watches the stream ``probe``.
        """
        return self._poses.get(stamp, {}) | self._forces.get(stamp, {})

    def _listen(self) -> None:
        if self._subscriptions.set_active(self._feed.is_watched) and self._feed.is_watched:
            self._forces.clear()  # they are from before the pause

    def _on_pose(self, message: PoseStamped) -> None:
        pose = pose_from(message, "patient")
        place = {"position": pose.position.tolist(), "quaternion": pose.orientation.tolist()}
        keep_newest(self._poses, _format_stamp(message), place, _UNIMAGED)
        self._offer()

    def _on_wrench(self, message: WrenchStamped) -> None:
        wrench = wrench_from(message, "probe").tolist()
        forces = {"force": wrench[:3], "torque": wrench[3:]}
        keep_newest(self._forces, _format_stamp(message), forces, _UNIMAGED)
        self._offer()

    def _offer(self) -> None:
        if not self._poses:
            return
        stamp, place = next(reversed(self._poses.items()))
        header = {"stamp": stamp, **place}
        if self._forces:
            force_stamp, force = next(reversed(self._forces.items()))
            age = round(1e-9 * (int(stamp) - int(force_stamp)), 3)
            header |= force | {"force_stamp": force_stamp, "force_age": age}
        self._feed.offer_packet(lambda sequence: Packet("probe", sequence, header, b""))


def _make_probe_mesh(message: MarkerArray, sequence: int) -> Packet:
    parts = read_surfaces(message, "probe")
    return make_transducer_packet("probe_mesh", sequence, parts, line_from(message, "probe"))


class SkinFeeds:
    """The streams ``skin_mesh``, of ``skin/mesh``, and ``skin``, of ``skin/nodes``."""

    def __init__(self, node: GuardedNode, post: CallPoster, rate: float) -> None:
        self._surface: StreamedSurface | None = None
        self.feeds: list[Feed] = [
            make_topic_feed(node, post, Mesh, "skin/mesh", self._rest, "skin_mesh", None, LATCHED),
            make_topic_feed(node, post, PointCloud2, "skin/nodes", self._move, "skin", rate),
        ]

    def _rest(self, message: Mesh, sequence: int) -> Packet:
        self._surface = StreamedSurface(*mesh_from(message))
        return self._surface.make_rest_packet("skin_mesh", sequence)

    def _move(self, message: PointCloud2, sequence: int) -> Packet | None:
        return _make_moved(self._surface, message, "skin", sequence)


def _make_moved(
    surface: StreamedSurface | None, message: PointCloud2, kind: str, sequence: int
) -> Packet | None:
    if surface is None:
        return None
    positions, stamp = vectors_from(message, "patient"), nanoseconds_of(message.header.stamp)
    return surface.make_packet(positions, kind=kind, sequence=sequence, stamp=stamp)


class RestMeshListener:
    """Follows the mesh of ``tissue/rest`` and ``tissue/tetrahedra`` while it has watchers.

    One object serves all users of the mesh, in the node's thread.

    Args:
        node: the node that subscribes.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._watchers: list[Callable[[], None]] = []
        self._subscriptions = Subscriptions(
            node,
            (PointCloud2, "tissue/rest", self._on_rest, LATCHED, False),
            (Int32MultiArray, "tissue/tetrahedra", self._on_tetrahedra, LATCHED, False),
        )
        self._rest: PointCloud2 | None = None
        self._tetrahedra: Int32MultiArray | None = None
        self.mesh: TetrahedralMesh | None = None
        self.surface: StreamedSurface | None = None  # its outer faces, with their edges

    def set_watcher(self, on_mesh: Callable[[], None], is_wanted: bool = True) -> None:
        """Call ``on_mesh`` for each new mesh from now on, or no longer; not for the present one."""
        if is_wanted == (on_mesh in self._watchers):
            return
        if is_wanted:
            self._watchers.append(on_mesh)
        else:
            self._watchers.remove(on_mesh)
        self._subscriptions.set_active(bool(self._watchers))

    def _on_rest(self, message: PointCloud2) -> None:
        self._rest = message
        self._make(is_complete=False)

    def _on_tetrahedra(self, message: Int32MultiArray) -> None:
        self._tetrahedra = message
        self._make(is_complete=True)

    def _make(self, is_complete: bool) -> None:
        """Make a mesh of both messages.

        Args:
            is_complete: the second message of a mesh has come; before, it may be another scene's.
        """
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
        surface = StreamedSurface.from_mesh(mesh)
        if self.surface is not None and surface.number == self.surface.number:
            return
        self.mesh, self.surface = mesh, surface
        for on_mesh in list(self._watchers):
            self._node.guard_callback(self._node.resolve_topic_name("tissue/rest"), on_mesh)()


class TissueFeeds:
    """The streams ``tissue_mesh``, ``tissue`` and ``strain``, of ``tissue/…``."""

    def __init__(
        self, node: GuardedNode, post: CallPoster, rate: float, rest: RestMeshListener
    ) -> None:
        self._rest = rest
        self._number: int | None = None  # of the mesh that was offered
        self._strain: tuple[TetrahedralMesh, EquivalentStrain] | None = None
        self._mesh = Feed("tissue_mesh", lambda _: post(self._listen), rate=None)
        slow = min(rate, _STRAIN_RATE)
        self.feeds: list[Feed] = [
            self._mesh,
            make_topic_feed(node, post, PointCloud2, _NODES, self._move, "tissue", rate),
            make_topic_feed(node, post, PointCloud2, _NODES, self._compute, "strain", slow),
        ]

    def _listen(self) -> None:
        """Follow meshes while a page watches, and offer the one that may be there already."""
        self._rest.set_watcher(self._offer, self._mesh.is_watched)
        self._offer()

    def _offer(self) -> None:
        surface = self._rest.surface
        if surface is not None and surface.number != self._number:
            self._number = surface.number
            self._mesh.offer_packet(
                lambda sequence: surface.make_rest_packet("tissue_mesh", sequence)
            )

    def _move(self, message: PointCloud2, sequence: int) -> Packet | None:
        return _make_moved(self._rest.surface, message, "tissue", sequence)

    def _compute(self, message: PointCloud2, sequence: int) -> Packet | None:
        """Compute the strain at the nodes; None before there is a mesh."""
        mesh, surface = self._rest.mesh, self._rest.surface
        if mesh is None or surface is None:
            return None
        if self._strain is None or self._strain[0] is not mesh:
            self._strain = mesh, EquivalentStrain(mesh)
        nodes = vectors_from(message, "patient")
        if nodes.shape != mesh.nodes.shape:
            raise MeshError(f"{len(nodes)} nodes came, and the mesh has {len(mesh.nodes)}")
        header = {"stamp": _format_stamp(message), "mesh": surface.number, "points": len(nodes)}
        values = self._strain[1].compute_strain(nodes).astype(np.float32)
        return Packet("strain", sequence, header, values.tobytes())


class StructuresFeed:
    """The stream ``structures``, of ``tissue/structures``.

    A message has three megabytes, and twenty come a second. The feed subscribes only until a
    message has the stamp of one of ``tissue/nodes``. Then it knows the place of each vertex in the
    tissue, and the page moves the structures with the tissue.
    """

    def __init__(self, node: GuardedNode, post: CallPoster, rest: RestMeshListener) -> None:
        self._node, self._post, self._rest = node, post, rest
        self.feed = Feed("structures", lambda _: post(self._listen), rate=None)
        self._subscriptions = Subscriptions(
            node,
            (PointCloud2, _NODES, self._on_nodes, STREAM, True),
            (MarkerArray, _STRUCTURES, self._on_structures, STREAM, True),
        )
        self._nodes: dict[int, bytes] = {}  # by stamp, ns
        self._structures: tuple[int, bytes] | None = None
        self._made_for: int | None = None  # the number of the mesh
        self._making: threading.Thread | None = None

    def forget_structures(self) -> None:
        """Drop the structures of the last scene; the next may have the same mesh."""
        self._made_for = None
        self.feed.forget_packet()
        self._listen()

    def _listen(self) -> None:
        """Follow meshes while watched, and nodes and structures until they have been used."""
        self._rest.set_watcher(self._listen, self.feed.is_watched)
        surface = self._rest.surface
        is_new = surface is not None and surface.number != self._made_for
        if is_new:
            self.feed.forget_packet()  # the tissue that carried them is of another scene
        if self._subscriptions.set_active(self.feed.is_watched and is_new and self._making is None):
            self._nodes.clear()
            self._structures = None

    def _on_nodes(self, data: bytes) -> None:
        stamp = make_from_message(
            self._node, PointCloud2, _NODES, data, lambda m: nanoseconds_of(m.header.stamp)
        )
        if stamp is not None:
            keep_newest(self._nodes, stamp, data, _UNPAIRED)
            self._start_making()

    def _on_structures(self, data: bytes) -> None:
        stamp = read_first_stamp(data)
        if stamp is not None:
            self._structures = stamp, data
            self._start_making()

    def _start_making(self) -> None:
        """Start to make the structures once they and the nodes with their stamp are there."""
        stamp, data = self._structures or (-1, b"")
        nodes, mesh, surface = self._nodes.get(stamp), self._rest.mesh, self._rest.surface
        if nodes is None or mesh is None or surface is None or self._making is not None:
            return
        self._making = threading.Thread(
            target=self._make,
            args=(mesh, surface.number, nodes, data),
            daemon=True,
            name="structures",
        )
        self._making.start()
        self._listen()

    def _make(self, mesh: TetrahedralMesh, number: int, nodes: bytes, structures: bytes) -> None:
        """Make the structures, in a thread of its own, and have them offered."""

        def carry(message: MarkerArray) -> CarriedSurfaces:
            surfaces = read_surfaces(message, "patient")
            if not surfaces:
                raise MeshError("there is no triangle in it")
            return CarriedSurfaces(TetrahedralMesh(deformed, mesh.tetrahedra), surfaces)

        deformed = make_from_message(
            self._node, PointCloud2, _NODES, nodes, lambda m: vectors_from(m, "patient")
        )
        carried = None
        if deformed is not None:
            carried = make_from_message(self._node, MarkerArray, _STRUCTURES, structures, carry)
        self._post(lambda: self._end(number, carried, is_wrong=deformed is not None))

    def _end(self, number: int, carried: CarriedSurfaces | None, is_wrong: bool) -> None:
        """Offer the structures; do not try unusable ones again."""
        self._making = None
        if carried is not None or is_wrong:
            self._made_for = number
        surface = self._rest.surface
        if carried is not None and surface is not None and surface.number == number:
            self.feed.offer_packet(
                lambda sequence: carried.make_rest_packet("structures", sequence, number)
            )
        self._listen()
