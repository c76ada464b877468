"""A context's place in a domain through Eclipse zenoh, among the nodes that run rmw_zenoh_cpp.

Topics are zenoh's keys, services its queryables; each node and endpoint has a liveliness token that
tells the others of it. As in rmw_zenoh every publisher fits every subscription: no quality of
service is refused, and deadlines and lifespans have no effect.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import zenoh
from zenoh import ext

from .interfaces import dds_name, type_hash
from .middleware import (
    EndpointQos,
    GraphEndpoint,
    GraphNode,
    MiddlewareError,
    Owner,
    RequestHeader,
    SampleInfo,
    numbers,
    qos_of_profile,
)
from .zenoh_config import open_session
from .zenoh_names import (
    CLIENT,
    DEFAULT_DEPTH,
    NODE,
    PUBLISHER,
    SERVICE,
    SUBSCRIPTION,
    Entity,
    all_tokens,
    attachment,
    read_attachment,
    read_token,
)

_HEARTBEAT = 0.5  # s, of latched publishers, so that a sample that was lost is noticed
_SETTLING = 0.1  # s; tokens come by the router, sooner than the link to their session is up
_PAUSE = 0.01  # s, between two tries
_OPEN_REQUESTS = 100  # of one service
_LONGEST_TRY = 10.0  # s, to reach a service that is said to be there


class Zenoh:
    """The `Middleware` that speaks zenoh; what its methods take and return is described there."""

    def __init__(self, domain_id: int, enclave: str) -> None:
        if not 0 <= domain_id <= 232:
            raise MiddlewareError(
                f"the domain id {domain_id} is not one of 0 to 232; set ROS_DOMAIN_ID"
            )
        self._domain, self._enclave = domain_id, enclave or "/"
        self._lock = threading.RLock()
        self._closed = False
        self._alive: dict[str, Entity] = {}  # by token
        self._since: dict[tuple[str, str], dict[str, float]] = {}  # by kind and key, then token
        self._announced: dict[int, GraphNode] = {}
        self._node_tokens: dict[int, Any] = {}
        self._open: weakref.WeakSet[_Endpoint] = weakref.WeakSet()
        self.session = open_session()
        self._id = str(self.session.info.zid())
        self._watch = self.session.liveliness().declare_subscriber(
            all_tokens(domain_id), self._token_changed, history=True
        )

    def create_publisher(
        self, owner: Owner, topic: str, kind: str, qos: Any, on_incompatible: Callable[[str], None]
    ) -> Writer:
        del on_incompatible  # there is nothing that does not fit
        return self._create(Writer, PUBLISHER, owner, topic, kind, qos)

    def create_subscription(
        self, owner: Owner, topic: str, kind: str, qos: Any, on_incompatible: Callable[[str], None]
    ) -> Reader:
        del on_incompatible
        return self._create(Reader, SUBSCRIPTION, owner, topic, kind, qos)

    def create_client(self, owner: Owner, service: str, kind: str, qos: Any) -> ServiceClient:
        return self._create(ServiceClient, CLIENT, owner, service, kind, qos)

    def create_service(self, owner: Owner, service: str, kind: str, qos: Any) -> ServiceServer:
        return self._create(ServiceServer, SERVICE, owner, service, kind, qos)

    def _create(
        self, cls: type[Any], role: str, owner: Owner, name: str, kind: str, qos: Any
    ) -> Any:
        if self._closed:
            raise MiddlewareError(f"the context is closed, so {name!r} cannot be joined")
        entity = replace(
            self._entity(role, owner.number, next(numbers), owner.namespace, owner.name),
            name=name,
            type_name=dds_name(kind),
            type_hash=type_hash(kind),
            qos=qos if isinstance(qos, EndpointQos) else qos_of_profile(qos, DEFAULT_DEPTH),
        )
        endpoint = cls(self, entity)
        self._open.add(endpoint)
        return endpoint

    def _entity(self, role: str, node: int, number: int, namespace: str, name: str) -> Entity:
        return Entity(self._domain, self._id, node, number, role, self._enclave, namespace, name)

    def announce(self, nodes: Iterable[GraphNode]) -> None:
        with self._lock:
            if self._closed:
                return
            known = {node.number: replace(node, participant=self._id.encode()) for node in nodes}
            for number in self._node_tokens.keys() - known.keys():
                self._node_tokens.pop(number).undeclare()
            for number in known.keys() - self._node_tokens.keys():
                node = known[number]
                entity = self._entity(NODE, number, number, node.namespace, node.name)
                self._node_tokens[number] = self.declare(entity)
            self._announced = known

    def declare(self, entity: Entity) -> Any:
        """Have an entity known to others for as long as the returned token is declared."""
        with self._lock:
            self._know(entity.token, entity, since=0.0)
        return self.session.liveliness().declare_token(entity.token)

    def _know(self, token: str, entity: Entity, since: float) -> None:
        self._alive[token] = entity
        self._since.setdefault((entity.kind, entity.key), {}).setdefault(token, since)

    def forget(self, token: str, entity: Entity) -> None:
        with self._lock:
            self._alive.pop(token, None)
            self._since.get((entity.kind, entity.key), {}).pop(token, None)

    def count(self, role: str, key: str) -> int:
        """The number of entities in a role on a key that are old enough to be reached."""
        settled = time.monotonic() - _SETTLING
        with self._lock:
            return sum(since <= settled for since in self._since.get((role, key), {}).values())

    def nodes(self) -> list[GraphNode]:
        with self._lock:
            others: dict[tuple[str, int], Entity] = {}
            gids: dict[tuple[str, int], tuple[list[bytes], list[bytes]]] = {}
            for each in self._alive.values():
                if each.session == self._id:
                    continue
                key = (each.session, each.node_number)
                if each.kind == NODE:
                    others[key] = each
                elif each.kind in (PUBLISHER, SUBSCRIPTION):
                    gids.setdefault(key, ([], []))[each.kind == PUBLISHER].append(each.gid)
            return [
                *self._announced.values(),
                *(_graph_node(node, *gids.get(key, ([], []))) for key, node in others.items()),
            ]

    def endpoints(self, topic: str | None = None) -> list[GraphEndpoint]:
        with self._lock:
            return [
                GraphEndpoint(
                    topic=f"rt{each.name}",
                    type_name=each.type_name,
                    is_writer=each.kind == PUBLISHER,
                    qos=each.qos,
                    gid=each.gid,
                    participant=each.session.encode(),
                    user_data={"typehash": each.type_hash},
                )
                for each in self._alive.values()
                if each.kind in (PUBLISHER, SUBSCRIPTION) and topic in (None, f"rt{each.name}")
            ]

    def close(self) -> None:
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self._alive.clear()
            self._since.clear()
            self._announced.clear()
        for endpoint in list(self._open):
            endpoint.closed = True
        self.session.close()

    def _token_changed(self, sample: Any) -> None:
        token = str(sample.key_expr)
        entity = read_token(token)
        with self._lock:
            if self._closed or entity is None or entity.session == self._id:
                return
            if sample.kind == zenoh.SampleKind.PUT:
                self._know(token, entity, time.monotonic())
            else:
                self.forget(token, entity)


def _graph_node(node: Entity, readers: list[bytes], writers: list[bytes]) -> GraphNode:
    session = node.session.encode()
    return GraphNode(node.namespace, node.node, tuple(readers), tuple(writers), session)


class _Endpoint:
    """Base of all endpoints: known to others until it is closed."""

    def __init__(self, middleware: Zenoh, entity: Entity) -> None:
        self.closed = False
        self._middleware = middleware
        self._entity = entity
        self._key = entity.key
        self._declared = self._declare(middleware.session, entity)
        self._token = middleware.declare(entity)
        self.gids: tuple[list[bytes], list[bytes]] = ([], [])
        self.gids[entity.kind in (PUBLISHER, CLIENT)].append(entity.gid)

    def _declare(self, session: Any, entity: Entity) -> Any:
        """Zenoh's publisher, subscriber, querier or queryable."""
        raise NotImplementedError

    def close(self) -> None:
        """Leave the topic or service. Callbacks that are running may end after this."""
        if self.closed:
            return
        self.closed = True
        self._middleware.forget(self._entity.token, self._entity)
        self._token.undeclare()
        self._declared.undeclare()

    def _attachment(self, sequence: int, gid: bytes) -> bytes:
        return attachment(sequence, time.time_ns(), gid)


class Writer(_Endpoint):
    """Sends samples to a topic."""

    _sequence = 0

    def _declare(self, session: Any, entity: Entity) -> Any:
        qos = entity.qos
        is_reliable = qos.reliability == EndpointQos.RELIABLE
        blocks = is_reliable and qos.history == EndpointQos.KEEP_ALL
        kinds, congestion = zenoh.Reliability, zenoh.CongestionControl
        options: dict[str, Any] = {
            "reliability": kinds.RELIABLE if is_reliable else kinds.BEST_EFFORT,
            "congestion_control": congestion.BLOCK if blocks else congestion.DROP,
        }
        self._sending = threading.Lock()
        self._gid = entity.gid
        if qos.durability != EndpointQos.TRANSIENT_LOCAL:
            return session.declare_publisher(entity.key, **options)
        if is_reliable:
            options["sample_miss_detection"] = ext.MissDetectionConfig(
                heartbeat=None, sporadic_heartbeat=_HEARTBEAT
            )
        return ext.declare_advanced_publisher(
            session,
            entity.key,
            cache=ext.CacheConfig(qos.depth),
            publisher_detection=True,
            **options,
        )

    def write(self, data: bytes) -> bool:
        """Send one sample. Always True: zenoh does not tell that it dropped one."""
        with self._sending:
            if self.closed:
                raise MiddlewareError("the writer is closed, so nothing can be published with it")
            self._sequence += 1
            try:
                self._declared.put(data, attachment=self._attachment(self._sequence, self._gid))
            except zenoh.ZError as error:
                raise MiddlewareError(f"a sample cannot be sent ({error})") from None
        return True

    def matched_count(self) -> int:
        return 0 if self.closed else self._middleware.count(SUBSCRIPTION, self._key)


class _Receiver(_Endpoint):
    """Keeps what arrived until it is taken, and calls back, from a thread of zenoh's."""

    _on_data: Callable[[], None] | None = None

    def __init__(self, middleware: Zenoh, entity: Entity) -> None:
        keeps_all = entity.qos.history == EndpointQos.KEEP_ALL
        self._waiting: deque[tuple[bytes, Any]] = deque(
            maxlen=None if keeps_all else entity.qos.depth
        )
        super().__init__(middleware, entity)

    def set_on_data(self, callback: Callable[[], None] | None) -> None:
        """Have a function called now and whenever something may be waiting."""
        self._on_data = callback
        if callback is not None:
            callback()

    def take(self) -> tuple[bytes, Any] | None:
        """The oldest sample, request or response that is waiting, with its origin."""
        try:
            return None if self.closed else self._waiting.popleft()
        except IndexError:
            return None

    def _keep(self, received: Any) -> tuple[bytes, int] | None:
        """Keep what a sample or a query brings; returns the gid and number in its attachment."""
        origin = received.attachment and read_attachment(received.attachment.to_bytes())
        if self.closed or not origin or received.payload is None:
            return None
        sequence, sent, gid = origin
        info = SampleInfo(sent, time.time_ns(), 0, sequence)
        is_sample = isinstance(self, Reader)
        self._waiting.append(
            (received.payload.to_bytes(), info if is_sample else RequestHeader(gid, sequence, info))
        )
        return gid, sequence

    def _notify(self) -> None:
        callback = self._on_data
        if callback is not None and not self.closed:
            callback()


class Reader(_Receiver):
    """Receives the samples of a topic."""

    def _declare(self, session: Any, entity: Entity) -> Any:
        qos = entity.qos
        if qos.durability != EndpointQos.TRANSIENT_LOCAL:
            return session.declare_subscriber(entity.key, self._received)
        options: dict[str, Any] = {}
        if qos.reliability == EndpointQos.RELIABLE:
            options["recovery"] = ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
        return ext.declare_advanced_subscriber(
            session,
            entity.key,
            self._received,
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth),
            subscriber_detection=True,
            **options,
        )

    def _received(self, sample: Any) -> None:
        if self._keep(sample) is not None:
            self._notify()

    def matched_count(self) -> int:
        return 0 if self.closed else self._middleware.count(PUBLISHER, self._key)


class ServiceServer(_Receiver):
    """Takes requests for a service and sends the responses.

    Of the requests that are not answered yet the newest 100 are kept.
    """

    on_unanswered: Callable[[str], object] | None = None

    def _declare(self, session: Any, entity: Entity) -> Any:
        self._queries: OrderedDict[tuple[bytes, int], Any] = OrderedDict()
        return session.declare_queryable(entity.key, self._received, complete=True)

    def _received(self, query: Any) -> None:
        origin = self._keep(query)
        if origin is None:
            query.drop()
            return
        self._queries[origin] = query
        if len(self._queries) > _OPEN_REQUESTS:
            self._queries.popitem(last=False)[1].drop()
            if self.on_unanswered is not None:
                self.on_unanswered(
                    f"since {_OPEN_REQUESTS} newer ones wait: answer them sooner, or ask less often"
                )
        self._notify()

    def send_response(self, data: bytes, header: RequestHeader) -> bool:
        """Answer a request; False if it was answered before."""
        query = self._queries.pop((header.client, header.sequence), None)
        if query is None or self.closed:
            return False
        with query:
            query.reply(
                self._entity.key,
                data,
                attachment=self._attachment(header.sequence, header.client),
            )
        return True


class ServiceClient(_Receiver):
    """Sends requests to a service and takes the responses to its own."""

    _sequence = 0

    def _declare(self, session: Any, entity: Entity) -> Any:
        self._sending = threading.Lock()
        self._gid = entity.gid
        return session.declare_querier(
            entity.key,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
        )

    def service_is_ready(self) -> bool:
        return not self.closed and self._middleware.count(SERVICE, self._key) > 0

    def send_request(self, data: bytes) -> int:
        """Send a serialized request; returns its sequence number."""
        with self._sending:
            self._sequence += 1
            sequence = self._sequence
        self._ask(data, self._attachment(sequence, self._gid), time.monotonic() + _LONGEST_TRY)
        return sequence

    def _ask(self, data: bytes, origin: bytes, deadline: float) -> None:
        """Send a request; once more if it was not sent on to a service that is there."""
        started, answered = time.monotonic(), False

        def reply(received: Any) -> None:
            nonlocal answered
            answered = True
            if received.ok is not None and self._keep(received.ok) is not None:
                self._notify()

        def ended() -> None:
            now = time.monotonic()
            was_refused = not answered and now - started < _SETTLING
            if was_refused and now < deadline and self.service_is_ready():
                time.sleep(_PAUSE)
                self._ask(data, origin, deadline)

        if not self.closed:
            handler = zenoh.handlers.Callback(reply, ended)
            self._declared.get(handler, payload=data, attachment=origin)
