"""Sessions of zenoh as rmw_zenoh opens them, and a router where none runs.

Sessions are peers that find each other through a router on this host and then speak directly.
rmw_zenoh wants the router (port 7447) to be started by hand. Sessions here use that one, whenever
it is started, and another (port 7448) that the first process has; when that ends, another process
takes it over: links between peers stay meanwhile.

ZENOH_SESSION_CONFIG_URI, ZENOH_ROUTER_CONFIG_URI and ZENOH_CONFIG_OVERRIDE mean what they mean to
rmw_zenoh. Of the discovery ranges, LOCALHOST keeps the router on the loopback interface, OFF keeps
sessions alone, and the others let the router be reached, and reach those of ROS_STATIC_PEERS.
"""

from __future__ import annotations

import json
import os
import re
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import zenoh

from .middleware import DiscoveryRange, MiddlewareError, loopback_fault

RMW_PORT, PORT = 7447, 7448
_WATCH_EVERY = 0.5  # s

# Where rmw_zenoh's files of configuration differ from zenoh's defaults.
_COMMON = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
    "timestamping/enabled": True,
    "transport/unicast/open_timeout": 60_000,  # ms, like the next ones
    "transport/unicast/accept_timeout": 60_000,
    "transport/unicast/accept_pending": 10_000,
    "transport/unicast/max_sessions": 10_000,
    "transport/link/tx/lease": 60_000,
    "transport/link/tx/keep_alive": 2,
}
_SESSION = _COMMON | {
    "mode": "peer",
    "connect/endpoints": [f"tcp/127.0.0.1:{port}" for port in (RMW_PORT, PORT)],
    "connect/timeout_ms": {"router": -1, "peer": -1, "client": 0},
    "connect/exit_on_failure": {"router": False, "peer": False, "client": True},
    "connect/retry": {  # sooner than rmw_zenoh: a router that ended is soon replaced
        "period_init_ms": 200,
        "period_max_ms": 1000,
        "period_increase_factor": 2,
    },
    "listen/endpoints": ["tcp/127.0.0.1:0"],
    "scouting/gossip/autoconnect_strategy": {
        "peer": {"to_router": "always", "to_peer": "greater-zid"}
    },
    "queries_default_timeout": 600_000,
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 60_000_000,  # µs
}
_ALONE = {"connect/endpoints": [], "listen/endpoints": [], "scouting/gossip/enabled": False}
_ROUTER = _COMMON | {
    "mode": "router",
    "routing/router/peers_failover_brokering": False,
    "scouting/delay": 0,  # ms that opening takes, where others may be found by multicast
}


def open_session(environment: Mapping[str, str] = os.environ) -> Any:
    """A session, after a router was opened if none answers where it connects to.

    Raises:
        MiddlewareError: the environment asks for something that cannot be had.
    """
    reach = DiscoveryRange.from_environment(environment)
    default = _SESSION | (_ALONE if reach.name == "OFF" else {})
    config = _config("SESSION", default, environment)
    port = None if reach.name == "OFF" else _local_port(config)
    if port is not None:
        if fault := loopback_fault():
            raise MiddlewareError(f"no zenoh session can be opened: {fault}")
        _keeper.need(port, reach, environment)
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise MiddlewareError(
            f"no zenoh session can be opened ({error}); check ZENOH_SESSION_CONFIG_URI and "
            f"ZENOH_CONFIG_OVERRIDE if they are set"
        ) from None
    _keeper.watch(session)
    return session


def _config(kind: str, default: Mapping[str, Any], environment: Mapping[str, str]) -> Any:
    """The configuration of a SESSION or a ROUTER."""
    variable = f"ZENOH_{kind}_CONFIG_URI"
    if file := environment.get(variable):
        try:
            config = zenoh.Config.from_file(file)
        except zenoh.ZError as error:
            raise MiddlewareError(f"{variable} is {file}, which cannot be read: {error}") from None
    else:
        config = zenoh.Config()
        for key, value in default.items():
            config.insert_json5(key, json.dumps(value))
    for pair in environment.get("ZENOH_CONFIG_OVERRIDE", "").split(";"):
        key, equals, text = pair.partition("=")
        if kind == "ROUTER" and key.startswith(("connect/", "listen/", "mode")):
            continue  # meant for sessions; the router has files of its own
        try:
            if equals:
                config.insert_json5(key, text)
        except zenoh.ZError as error:
            raise MiddlewareError(f"ZENOH_CONFIG_OVERRIDE has {pair!r}: {error}") from None
    return config


def _local_port(config: Any) -> int | None:
    """The last port on this host where the session looks for a router; None if there is none."""
    endpoints = json.loads(config.get_json("connect/endpoints"))
    found = [
        re.fullmatch(r"tcp/(?:localhost|127\.0\.0\.1|\[::1\]):(\d+)", each)
        for each in (endpoints if isinstance(endpoints, list) else [])
    ]
    return next((int(match[1]) for match in reversed(found) if match), None)


class _Keeper:
    """Opens a router in this process when its sessions have none, and closes all at its end."""

    def __init__(self) -> None:
        self._sessions: list[Any] = []
        self._lock = threading.Lock()
        self._router: Any = None
        self._config: Any = None
        self._thread: threading.Thread | None = None

    def need(self, port: int, reach: DiscoveryRange, environment: Mapping[str, str]) -> None:
        """Have a router on this port from now on, this process's or another one's."""
        with self._lock:
            if self._config is not None:
                return
            host = "127.0.0.1" if reach.name == "LOCALHOST" else "0.0.0.0"
            peers = [f"tcp/{peer}:{p}" for peer in reach.static_peers for p in (RMW_PORT, PORT)]
            default = {"listen/endpoints": [f"tcp/{host}:{port}"], "connect/endpoints": peers}
            self._config = _config("ROUTER", _ROUTER | default, environment)
            self._open()

    def watch(self, session: Any) -> None:
        """Open a router whenever this session, and all the others here, have lost theirs."""
        with self._lock:
            self._sessions.append(session)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="zenoh sessions")
                self._thread.start()

    def _open(self) -> None:
        with suppress(zenoh.ZError):  # somebody else has the port
            self._router = zenoh.open(self._config)

    def _run(self) -> None:
        # Python waits for the threads in which zenoh calls back, so closing from `atexit` is late.
        program = threading.main_thread()
        program.join(_WATCH_EVERY)
        while program.is_alive():
            with self._lock:
                self._sessions = sessions = [s for s in self._sessions if not s.is_closed()]
            is_lost = sessions and not any(each.info.routers_zid() for each in sessions)
            if self._config is not None and self._router is None and is_lost:
                self._open()
            program.join(_WATCH_EVERY)
        for each in self._sessions:
            each.close()
        if self._router is not None:
            self._router.close()


_keeper = _Keeper()
