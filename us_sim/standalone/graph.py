"""Who is in a DDS domain: endpoints, and the ROS nodes that they belong to.

Endpoints come from DDS's own discovery. Which of them make up a node is what every ROS participant
publishes on ``ros_discovery_info`` (rmw_dds_common/msg/ParticipantEntitiesInfo).
"""

from __future__ import annotations

import ctypes as ct
import threading
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from . import ddsc
from .cdr import CdrError, deserialize, serialize
from .ddsc import (
    BuiltinEndpoint,
    BuiltinParticipant,
    RawSampleInfo,
    check,
    lib,
    read_qos,
    user_data,
)
from .interfaces import type_hash
from .messages import message_class
from .middleware import EndpointQos, GraphEndpoint, GraphNode
from .transport import Participant

_BUILTIN_TOPICS = {
    ddsc.BUILTIN_PARTICIPANT: BuiltinParticipant,
    ddsc.BUILTIN_PUBLICATION: BuiltinEndpoint,
    ddsc.BUILTIN_SUBSCRIPTION: BuiltinEndpoint,
}
_TOPIC = "ros_discovery_info"
_TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
_DDS_TYPE = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"


class Graph:
    """The endpoints and nodes of a domain, as far as they have been received."""

    def __init__(self, participant: Participant) -> None:
        self._participant = participant
        self._lock = threading.RLock()
        self._closed = False
        self._endpoints: dict[bytes, GraphEndpoint] = {}
        self._participants: set[bytes] = set()  # the others
        self._nodes: dict[bytes, tuple[GraphNode, ...]] = {}
        self._announced: tuple[GraphNode, ...] = ()
        self._builtin = {
            topic: check(
                lib.dds_create_reader(participant.handle, topic, None, None),
                "the domain cannot be observed",
            )
            for topic in _BUILTIN_TOPICS
        }
        latched = EndpointQos(durability=EndpointQos.TRANSIENT_LOCAL, depth=1)
        hash_of_type = f"typehash={type_hash(_TYPE)};"
        self._writer = participant.create_writer(_TOPIC, _DDS_TYPE, latched, hash_of_type)
        # Every participant writes this topic, which has no key, so all samples must be kept.
        self._reader = participant.create_reader(
            _TOPIC,
            _DDS_TYPE,
            replace(latched, history=EndpointQos.KEEP_ALL),
            hash_of_type,
            ignore_own=True,
        )
        self._reader.set_on_data(self._refresh)  # or they would pile up until somebody asks

    def endpoints(self, topic: str | None = None) -> list[GraphEndpoint]:
        """All endpoints, or those on one DDS topic."""
        with self._lock:
            self._refresh()
            return [
                endpoint
                for endpoint in self._endpoints.values()
                if topic is None or endpoint.topic == topic
            ]

    def nodes(self) -> list[GraphNode]:
        """All nodes: this participant's first, then the others'."""
        with self._lock:
            self._refresh()
            others = [
                node
                for gid, nodes in self._nodes.items()
                if gid in self._participants
                for node in nodes
            ]
            return [*self._announced, *others]

    def announce(self, nodes: Iterable[GraphNode]) -> None:
        """Publish which nodes this participant has, and with which endpoints."""
        with self._lock:
            if self._closed:
                return
            gid = self._participant.gid
            self._announced = tuple(replace(node, participant=gid) for node in nodes)
            self._writer.write(serialize(_to_message(gid, self._announced)))

    def close(self) -> None:
        """Learn nothing more, and forget everything."""
        with self._lock:
            self._closed = True
            self._announced = ()
            self._endpoints.clear()
            self._nodes.clear()

    def _refresh(self) -> None:
        with self._lock:
            if self._closed:
                return
            for topic, kind in _BUILTIN_TOPICS.items():
                self._take_all(topic, kind)
            while (sample := self._reader.take()) is not None:
                try:
                    message: Any = deserialize(sample[0], message_class(_TYPE))
                except CdrError:
                    continue
                gid = bytes(message.gid.data)
                self._nodes[gid] = tuple(_from_message(message, gid))

    def _take_all(self, topic: int, kind: Any) -> None:
        reader = self._builtin[topic]
        sample, info = ct.c_void_p(), RawSampleInfo()
        while lib.dds_take(reader, ct.byref(sample), ct.byref(info), 1, 1) == 1:
            content = ct.cast(sample, ct.POINTER(kind)).contents
            is_alive = info.instance_state == ddsc.ALIVE
            try:
                if is_alive and not info.valid_data:
                    continue
                if kind is BuiltinParticipant:
                    self._take_participant(content, is_alive)
                else:
                    self._take_endpoint(content, is_alive, topic == ddsc.BUILTIN_PUBLICATION)
            finally:
                lib.dds_return_loan(reader, ct.byref(sample), 1)
                sample.value = None

    def _take_participant(self, content: Any, is_alive: bool) -> None:
        gid = bytes(content.key)
        if not is_alive:
            self._participants.discard(gid)
            self._nodes.pop(gid, None)
        elif gid != self._participant.gid and "enclave" in user_data(content.qos):
            self._participants.add(gid)

    def _take_endpoint(self, content: Any, is_alive: bool, is_writer: bool) -> None:
        gid = bytes(content.key)
        if not is_alive:
            self._endpoints.pop(gid, None)
            return
        topic = content.topic_name.decode("utf-8", "replace")
        if not topic.startswith("DCPS"):
            self._endpoints[gid] = GraphEndpoint(
                topic=topic,
                type_name=content.type_name.decode("utf-8", "replace"),
                is_writer=is_writer,
                qos=read_qos(content.qos),
                gid=gid,
                participant=bytes(content.participant_key),
                user_data=user_data(content.qos),
            )


def _gid_message(gid: bytes) -> Any:
    return message_class("rmw_dds_common/msg/Gid")(data=np.frombuffer(gid, np.uint8))


def _to_message(gid: bytes, nodes: Iterable[GraphNode]) -> Any:
    node_class = message_class("rmw_dds_common/msg/NodeEntitiesInfo")
    return message_class(_TYPE)(
        gid=_gid_message(gid),
        node_entities_info_seq=[
            node_class(
                node_namespace=node.namespace,
                node_name=node.name,
                reader_gid_seq=[_gid_message(gid) for gid in node.reader_gids],
                writer_gid_seq=[_gid_message(gid) for gid in node.writer_gids],
            )
            for node in nodes
        ],
    )


def _from_message(message: Any, gid: bytes) -> Iterable[GraphNode]:
    for node in message.node_entities_info_seq:
        yield GraphNode(
            namespace=node.node_namespace,
            name=node.node_name,
            reader_gids=tuple(bytes(entry.data) for entry in node.reader_gid_seq),
            writer_gids=tuple(bytes(entry.data) for entry in node.writer_gid_seq),
            participant=gid,
        )
