"""What a node reports about itself once a second: rate, latency, drops, state."""

from __future__ import annotations

import os
import time
from collections import Counter, deque

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from us_sim.nodes.conversions.stamps import nanoseconds_of
from us_sim.nodes.guarded_node import shown
from us_sim.nodes.qos import STREAM, overridable

SAY_S = 5.0
"""How long a problem of the same kind is not said again; each time it is twice as long."""
SAY_AT_LEAST_S = 300.0
"""How long at most."""
ANOTHER_CLOCK_S = 10.0
"""From the present to a stamp: from there on it is of another clock, or of an earlier day."""


class Health:
    """Counts what a node does and publishes it on ``diagnostics`` at 1 Hz.

    Latency is the age of what goes out by its stamp. Where stamps are of another clock, as those
    of a recording are, that is said once, and latency counts from the arrival of what a message
    was made from.

    Args:
        node: whose clock, logger and timer are used.
        hardware_id: the scene's name, or what else the node works on.
    """

    def __init__(self, node: Node, hardware_id: str) -> None:
        self._node = node
        self._hardware_id = hardware_id
        self._latencies: deque[float] = deque(maxlen=1000)
        self._published: Counter[str] = Counter()
        self._problems: Counter[str] = Counter()
        self._next: dict[str, tuple[float, float]] = {}  # s, when to say it again, and then when
        self._last_problem = self._last_kind = ""
        self.warning = ""  # what is wrong for as long as it is
        self._failures_told = 0
        self._clock_differs = False
        self._last_total = 0
        self._last_time = node.get_clock().now().nanoseconds
        self.state = "starting"
        self.received = 0
        self.dropped = 0
        self.values: dict[str, str] = {}
        self.preparing = ""  # what it goes on without until that is ready
        self.scheduling = ""  # how its process goes before others, if that was asked for
        self._publisher = node.create_publisher(
            DiagnosticArray, "diagnostics", STREAM, qos_overriding_options=overridable()
        )
        node.create_timer(1.0, self.report)
        self._first = node.create_timer(0.01, self._report_first)

    def published(self, topic: str, stamp: TimeMessage | None = None) -> None:
        """One message went out on ``topic``; with a stamp, its age counts as latency."""
        self._published[topic] += 1
        if stamp is not None:
            self._latencies.append(1e3 * self._age(nanoseconds_of(stamp)))

    def _age(self, stamp: int) -> float:
        """s, of something with that stamp in ns."""
        age = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp)
        if abs(age) < ANOTHER_CLOCK_S:
            return age
        if not self._clock_differs:
            self._clock_differs = True
            self._node.get_logger().warning(
                f"stamps are {abs(age):.1f} s {'old' if age > 0 else 'ahead'}, so they are of "
                f"another clock: latency counts from arrival"
            )
        return 1e-9 * (time.monotonic_ns() - getattr(self._node, "arrived", time.monotonic_ns()))

    def problem(self, kind: str, sentence: str) -> None:
        """Count a problem of that kind; one that goes on is logged ever more rarely."""
        self._problems[kind] += 1
        self._last_problem = sentence = shown(sentence)
        self._last_kind = kind
        now = time.monotonic()
        due, wait = self._next.get(kind, (now, SAY_S))
        if now >= due:
            self._next[kind] = now + wait, min(2 * wait, SAY_AT_LEAST_S)
            self._node.get_logger().warning(sentence)

    def problems(self, kind: str) -> int:
        """How many of that kind there were."""
        return self._problems[kind]

    def _report_first(self) -> None:
        """As soon as the node takes part: somebody waits for it."""
        self._first.cancel()
        self.report()

    def report(self) -> None:
        """Publish what there is to say: once a second, and when it must be known at once."""
        now = self._node.get_clock().now()
        elapsed = max(now.nanoseconds - self._last_time, 1) * 1e-9
        total = max(self._published.values(), default=0)
        rate = (total - self._last_total) / elapsed
        self._last_time, self._last_total = now.nanoseconds, total
        values = {
            "state": self.state,
            "pid": str(os.getpid()),
            "rate_hz": f"{rate:.1f}",
            "received": str(self.received),
            "dropped": str(self.dropped),
            **({"preparing": self.preparing} if self.preparing else {}),
            **({"problem": self._last_kind} if self._last_problem else {}),
            **({"scheduling": self.scheduling} if self.scheduling else {}),
            **{f"published {topic}": str(n) for topic, n in self._published.items()},
            **{f"rejected {kind}": str(n) for kind, n in self._problems.items()},
            **{f"failed {where}": str(n) for where, n in self._failures().items()},
            **self.values,
        }
        if self._latencies:
            p50, p99 = np.percentile(self._latencies, [50, 99])
            values |= {"latency_p50_ms": f"{p50:.2f}", "latency_p99_ms": f"{p99:.2f}"}
        self._publisher.publish(self._message(now.to_msg(), values))
        self._last_problem = ""

    def _failures(self) -> Counter[str]:
        """Exceptions that nobody expected, by where they happened."""
        return Counter(getattr(self._node, "failures", ()))

    def _message(self, stamp: TimeMessage, values: dict[str, str]) -> DiagnosticArray:
        status = DiagnosticStatus()
        wrong = self._last_problem or self.warning
        status.level = DiagnosticStatus.WARN if wrong else DiagnosticStatus.OK
        failures = self._failures().total()
        if failures > self._failures_told:
            self._failures_told, wrong = failures, self._node.last_failure
            status.level = DiagnosticStatus.ERROR
        status.name = self._node.get_fully_qualified_name()
        status.message = wrong or self.state
        status.hardware_id = self._hardware_id
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        message = DiagnosticArray()
        message.header.stamp = stamp
        message.status = [status]
        return message
