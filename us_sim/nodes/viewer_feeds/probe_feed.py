"""The probe: its shape once, and where it is with the force that it feels."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped, WrenchStamped
from visualization_msgs.msg import MarkerArray

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.messages import (
    line_from,
    nanoseconds_of,
    pose_from,
    wrench_from,
)
from us_sim.nodes.posted import Posted
from us_sim.nodes.qos import LATCHED, STREAM
from us_sim.nodes.viewer_feeds.marker_surfaces import surfaces_of
from us_sim.nodes.viewer_feeds.watched_topic import WatchedTopic, made_of
from us_sim.viewer.feed import Feed
from us_sim.viewer.meshes.transducer import transducer_packet
from us_sim.viewer.packet import Packet

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
