"""Who is in a DDS domain: endpoints, and the ROS nodes that they belong to.

Endpoints come from DDS's own discovery. Which of them make up a node is what every ROS participant
publishes on ``ros_discovery_info`` (rmw_dds_common/msg/ParticipantEntitiesInfo).
"""

from __future__ import annotations

import ctypes as ct
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from us_sim.standalone import ddsc
from us_sim.standalone.cdr import CdrError, deserialize, serialize
from us_sim.standalone.ddsc import BuiltinEndpoint, BuiltinParticipant, RawSampleInfo, check, lib
from us_sim.standalone.endpoint_qos import EndpointQos, read_qos, user_data
from us_sim.standalone.interfaces import type_hash
from us_sim.standalone.message_class import message_class

if TYPE_CHECKING:
    from us_sim.standalone.transport import Participant

__all__ = ["Graph", "GraphEndpoint", "GraphNode"]

_TOPIC = "ros_discovery_info"
_TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
_DDS_TYPE = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"
_DATA_AVAILABLE = 1 << 8


@dataclass(frozen=True)
class GraphEndpoint:
    """A reader or writer in the domain, this process's included.

    Attributes:
        topic, type_name: DDS names.
        gid, participant: 16 bytes each.
        user_data: the ``key=value;`` pairs, such as ``typehash``, ``serviceid`` and ``clientid``.
    """

    topic: str
    type_name: str
    is_writer: bool
    qos: EndpointQos
    gid: bytes
    participant: bytes
    user_data: dict[str, str]


@dataclass(frozen=True)
class GraphNode:
    """A ROS node and the gids of its endpoints.

    Attributes:
        participant: the gid of its participant; filled in for nodes that are announced.
    """

    namespace: str
    name: str
    reader_gids: tuple[bytes, ...] = ()
    writer_gids: tuple[bytes, ...] = ()
    participant: bytes = b""
    enclave: str = "/"


class Graph:
    """What is known of a domain, always up to date with what has been received.

    ``on_change`` may be set to a function without arguments; it is called from another thread after
    something appeared, changed or went.
    """

    def __init__(self, participant: Participant) -> None:
        self.on_change: Callable[[], None] | None = None
        self._participant = participant
        self._lock = threading.RLock()
        self._closed = False
        self._endpoints: dict[bytes, GraphEndpoint] = {}
        self._enclaves: dict[bytes, str] = {}
        self._nodes: dict[bytes, tuple[GraphNode, ...]] = {}
        self._announced: tuple[GraphNode, ...] = ()
        self._builtin = {
            topic: check(
                lib.dds_create_reader(participant._handle, topic, None, None),
                "the domain cannot be observed",
            )
            for topic in (
                ddsc.BUILTIN_PARTICIPANT,
                ddsc.BUILTIN_PUBLICATION,
                ddsc.BUILTIN_SUBSCRIPTION,
            )
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
        self._reader.on_data = self._something_came
        for reader in self._builtin.values():
            participant._dispatcher.attach(reader, _DATA_AVAILABLE, self._something_came)

    def endpoints(self, topic: str | None = None) -> list[GraphEndpoint]:
        """All endpoints, or those on one DDS topic."""
        self._refresh_early()
        with self._lock:
            return [
                endpoint
                for endpoint in self._endpoints.values()
                if topic is None or endpoint.topic == topic
            ]

    def nodes(self) -> list[GraphNode]:
        """All nodes: this participant's first, then the others'."""
        self._refresh_early()
        with self._lock:
            others = [
                replace(node, enclave=self._enclaves[gid])
                for gid, nodes in self._nodes.items()
                if gid in self._enclaves
                for node in nodes
            ]
            return [*self._announced, *others]

    def announce(self, nodes: Iterable[GraphNode]) -> None:
        """Publish which nodes this participant has, and with which endpoints."""
        with self._lock:
            if self._closed:
                return
            self._announced = tuple(
                replace(node, participant=self._participant.gid, enclave=self._participant.enclave)
                for node in nodes
            )
            self._writer.write(serialize(_to_message(self._participant.gid, self._announced)))
        self._participant._dispatcher.call_soon(self.notify)

    def close(self) -> None:
        """Learn nothing more, and forget everything."""
        with self._lock:
            self._closed = True
            self.on_change = None
            self._announced = ()
            for known in (self._endpoints, self._enclaves, self._nodes):
                known.clear()

    def _something_came(self) -> None:
        # Reading leaves nothing to trigger on, so the status needs no separate reset.
        if self._refresh():
            self.notify()

    def _refresh_early(self) -> None:
        """Take in what the dispatcher has not seen yet, and have ``on_change`` told of it."""
        if self._refresh():
            self._participant._dispatcher.call_soon(self.notify)

    def notify(self) -> None:
        """Call ``on_change``."""
        callback = self.on_change
        if callback is not None:
            callback()

    def _refresh(self) -> bool:
        """Take in what was received; whether there was anything."""
        with self._lock:
            if self._closed:
                return False
            participants = self._take_all(ddsc.BUILTIN_PARTICIPANT, self._take_participant)
            writers = self._take_all(ddsc.BUILTIN_PUBLICATION, self._take_endpoint)
            readers = self._take_all(ddsc.BUILTIN_SUBSCRIPTION, self._take_endpoint)
            changed = participants or writers or readers
            while (sample := self._reader.take()) is not None:
                changed = True
                try:
                    message: Any = deserialize(sample[0], message_class(_TYPE))
                except CdrError:
                    continue
                gid = bytes(message.gid.data)
                self._nodes[gid] = tuple(_from_message(message, gid))
            return changed

    def _take_all(self, topic: int, take: Callable[[Any, bool, bool], None]) -> bool:
        reader = self._builtin[topic]
        kind: Any = BuiltinParticipant if topic == ddsc.BUILTIN_PARTICIPANT else BuiltinEndpoint
        sample, info = ct.c_void_p(), RawSampleInfo()
        changed = False
        while lib.dds_take(reader, ct.byref(sample), ct.byref(info), 1, 1) == 1:
            content = ct.cast(sample, ct.POINTER(kind)).contents
            is_alive = info.instance_state == ddsc.ALIVE
            if info.valid_data or not is_alive:
                take(content, is_alive, topic == ddsc.BUILTIN_PUBLICATION)
                changed = True
            lib.dds_return_loan(reader, ct.byref(sample), 1)
            sample.value = None
        return changed

    def _take_participant(self, content: Any, is_alive: bool, _is_writer: bool) -> None:
        gid = bytes(content.key)
        if gid == self._participant.gid:
            return
        if not is_alive:
            self._enclaves.pop(gid, None)
            self._nodes.pop(gid, None)
            return
        enclave = user_data(content.qos).get("enclave")
        if enclave is not None:
            self._enclaves[gid] = enclave

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
