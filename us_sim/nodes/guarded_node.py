"""A node that goes on whatever comes in, refuses bad input, and reports its health.

The report, once a second: rate, latency, drops, state.
"""

from __future__ import annotations

import inspect
import os
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType, ROSClock
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from us_sim.errors import UsSimError, printable
from us_sim.nodes import ros_refusal
from us_sim.nodes.qos import LATCHED, SENT, overridable
from us_sim.recording.decoding import nanoseconds_of, require_stamp

CLOCK_S = 5.0  # for simulated time to begin, before it is said that it does not
SAY_S = 1.0  # how long the same failure is not said again
FAILED = "it failed; see the node's log"
_DONE, _CODE, _REASON = ("success", "successful"), ("return_code",), ("error_string", "message")
"""Fields by which responses usually say whether what was asked for was done, and why not."""
LONGEST = 500  # characters of a sentence: an error may quote all of a message


class GuardedNode(Node):
    """A node whose callbacks are guarded: an exception ends neither this node nor others.

    Bad input, an error of this package, is *refused*: said, and counted by its kind. Any other
    exception is a *failure*: counted by where it happened, said once a second at most, its
    traceback at log level debug. `Health` puts both in diagnostics.

    Messages whose stamps are no time are refused, too, but for those that are asked for ``raw``.
    """

    health: Health  # where the node has one

    def __init__(self, name: str, **kwargs: Any) -> None:
        self.failures: Counter[str] = Counter()
        self.last_failure = ""
        self.arrived = time.monotonic_ns()
        """When what is being worked on came, ns of the monotonic clock."""
        self._said: dict[str, float] = {}
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        try:
            super().__init__(name, **kwargs)
        except RuntimeError as error:  # an RCLError
            raise ros_refusal(error) from error
        if self.time_is_simulated:
            self._clockless = self.create_timer(CLOCK_S, self._look_for_a_clock)

    @property
    def time_is_simulated(self) -> bool:
        """Whether the node's time is that of ``/clock``."""
        clock = self.get_clock()
        return isinstance(clock, ROSClock) and clock.ros_time_is_active

    def _look_for_a_clock(self) -> None:
        """Say that simulated time does not begin."""
        self._clockless.cancel()
        if not self.get_clock().now().nanoseconds:
            self.get_logger().warning(
                "use_sim_time is true, and nothing has come on /clock: this node's time stands at "
                "0; start what publishes it, or set use_sim_time to false"
            )

    def refused(self, where: str, error: UsSimError) -> None:
        """Count and say that something which came in cannot be used."""
        sentence = shown(f"{where}: {error}; it is not used")
        if hasattr(self, "health"):
            self.health.problem(kind_of(error), sentence)
        elif self._is_time_to_say(where):
            self.get_logger().warning(sentence)

    def failed(self, where: str, error: Exception) -> None:
        """Count and say an exception that nobody expected; any thread may."""
        self.failures[where] += 1
        self.last_failure = shown(f"{where}: {type(error).__name__}: {error}")
        if self._is_time_to_say(where):
            self.get_logger().error(
                f"{self.last_failure}; the node goes on (failure {self.failures[where]} of this "
                f"kind; the traceback is at log level debug)"
            )
            self.get_logger().debug("".join(traceback.format_exception(error)))

    def guarded(
        self,
        where: str,
        callback: Callable[..., Any],
        otherwise: Callable[..., Any] = lambda *_: None,
    ) -> Callable[..., Any]:
        """The callback, which raises no more, unless the node is being ended.

        Args:
            where: the topic, or what else a person knows it by.
            callback: takes what it takes.
            otherwise: gives what is returned when the callback raises, from the same arguments.
        """

        def call(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except ExternalShutdownException:
                raise
            except Exception as error:
                if not self.context.ok():
                    raise  # whatever was broken off by the end
                if isinstance(error, UsSimError):
                    self.refused(where, error)
                else:
                    self.failed(where, error)
                return otherwise(*arguments)

        return call

    def stream(self, message_type: Any, topic: str, qos: QoSProfile = SENT) -> Publisher:
        """Create a publisher whose quality of service may be overridden by parameters."""
        return self.create_publisher(message_type, topic, qos, qos_overriding_options=overridable())

    def latched(self, message_type: Any, topic: str) -> Publisher:
        """Likewise, of messages that are kept for later subscribers."""
        return self.stream(message_type, topic, LATCHED)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Any:
        """As `rclpy.node.Node.create_subscription`, guarded.

        The quality of service of a relative topic may be overridden by parameters; absolute ones
        are ROS's own, and what a recorder adopts.
        """
        if not topic.startswith("/"):
            options.setdefault("qos_overriding_options", overridable())
        if not options.get("raw"):
            callback = _with_a_stamp(callback)
        entered = self._entered(self.resolve_topic_name(topic), callback)
        return super().create_subscription(msg_type, topic, entered, qos_profile, **options)

    def create_timer(self, timer_period_sec: float, callback: Any, *args: Any, **kw: Any) -> Any:
        """As `rclpy.node.Node.create_timer`, guarded, and by real time unless a clock is given.

        Reports and whatever else serves the node itself go on while simulated time stands.
        """
        entered = self._entered(f"timer {_name(callback)}", callback)
        return super().create_timer(
            timer_period_sec, entered, *args, **{"clock": self._steady, **kw}
        )

    def call_soon(self, callback: Callable[[], Any]) -> None:
        """Have the executor call ``callback``, guarded; any thread may ask for that."""
        if self.executor is not None:  # else it has ended, or has not begun
            self.executor.create_task(self._entered(_name(callback), callback))

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, **options: Any) -> Any:
        """As `rclpy.node.Node.create_service`, guarded: a request that fails is told that."""
        entered = self._entered(f"service {srv_name}", callback, _refusing)
        return super().create_service(srv_type, srv_name, entered, **options)

    def add_on_set_parameters_callback(self, callback: Any) -> None:
        """As `rclpy.node.Node.add_on_set_parameters_callback`; an exception refuses the change."""

        def refuse(_: Any) -> SetParametersResult:
            return SetParametersResult(successful=False, reason=FAILED)

        super().add_on_set_parameters_callback(self.guarded("parameters", callback, refuse))

    def add_post_set_parameters_callback(self, callback: Any) -> None:
        """As `rclpy.node.Node.add_post_set_parameters_callback`, guarded."""
        super().add_post_set_parameters_callback(self.guarded("parameters", callback))

    def _entered(
        self, where: str, callback: Any, otherwise: Callable[..., Any] = lambda *_: None
    ) -> Callable[..., Any]:
        """The guarded callback, which says when it began; rclpy looks at its arguments."""
        guarded = self.guarded(where, callback, otherwise)

        def enter(*arguments: Any) -> Any:
            self.arrived = time.monotonic_ns()
            return guarded(*arguments)

        enter.__signature__ = inspect.signature(callback)  # type: ignore[attr-defined]
        return enter

    def _is_time_to_say(self, where: str) -> bool:
        now = time.monotonic()
        if now - self._said.get(where, -SAY_S) < SAY_S:
            return False
        self._said[where] = now
        return True


class Subscriptions:
    """Subscriptions that are there or not, all together.

    Args:
        node: that subscribes.
        wanted: type, topic, callback, quality of service, and whether bytes are handed over.
    """

    def __init__(self, node: GuardedNode, *wanted: tuple[Any, str, Any, QoSProfile, bool]) -> None:
        self._node, self._wanted = node, wanted
        self._there: list[Any] = []

    def keep(self, is_wanted: bool) -> bool:
        """Subscribe, or no longer; whether that is a change."""
        if is_wanted == bool(self._there):
            return False
        for subscription in self._there:
            self._node.destroy_subscription(subscription)
        self._there = []
        if is_wanted:
            self._there = [
                self._node.create_subscription(kind, topic, take, qos, raw=raw)
                for kind, topic, take, qos, raw in self._wanted
            ]
        return True


def _with_a_stamp(work: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return ``work``, which raises StampError for messages whose stamps are no time."""

    def take(message: Any) -> Any:
        require_stamp(message)
        return work(message)

    return take


def kind_of(error: UsSimError) -> str:
    """The kind that an error is counted as: ``pose`` of a PoseError."""
    return type(error).__name__.removesuffix("Error").lower()


def _refusing(request: Any, response: Any) -> Any:
    """The response, which states the failure where it has a field for it."""
    refused = SetParametersResult(successful=False, reason=FAILED)
    if hasattr(response, "results") and hasattr(request, "parameters"):
        response.results = [refused for _ in request.parameters]
    if hasattr(getattr(response, "result", None), "successful"):
        response.result = refused
    for name in response.get_fields_and_field_types():
        if name in _DONE:
            setattr(response, name, False)
        elif name in _CODE:
            setattr(response, name, 1)
        elif name in _REASON:
            setattr(response, name, FAILED)
    return response


def _name(callback: Any) -> str:
    return getattr(callback, "__qualname__", type(callback).__name__)


def shown(sentence: str) -> str:
    """The sentence as it may be logged: it may quote a message."""
    return printable(" ".join(sentence[: LONGEST + 1].split()), LONGEST)


REPEAT_S = 5.0
"""How long a problem of the same kind is not said again; each time it is twice as long."""
SAY_AT_LEAST_S = 300.0  # how long at most
ANOTHER_CLOCK_S = 10.0
"""From the present to a stamp: from there on it is of another clock, or of an earlier day."""


class Health:
    """Counts of a node's work, published on ``diagnostics`` at 1 Hz.

    Its level is ERROR while a fault keeps the node from its work and after an exception that nobody
    expected, WARN while something is wrong and after bad input, and else OK.

    Latency is the age of what goes out by its stamp. It counts from the arrival of what a message
    was made from under simulated time, which goes in steps, and where stamps are of another clock,
    as those of a recording are; the latter is said once. An age below zero is a clock that is
    wrong, on this computer or another one.

    Args:
        node: whose clock, logger and timer are used.
        hardware_id: the scene's name, or what else the node works on.
    """

    def __init__(self, node: GuardedNode, hardware_id: str) -> None:
        self._node = node
        self._hardware_id = hardware_id
        self._latencies: deque[float] = deque(maxlen=1000)
        self._published: Counter[str] = Counter()
        self._problems: Counter[str] = Counter()
        self._next: dict[str, tuple[float, float]] = {}  # s, when to say it again, and then when
        self._last_problem = self._last_kind = ""
        self.warning = ""  # what is wrong for as long as it is
        self.fault = ""  # likewise, where it keeps the node from its work
        self._failures_told = 0
        self._clock_differs = False
        self._last_total = 0
        self._last_time = time.monotonic()
        self.state = "starting"
        self.received = 0
        self.dropped = 0
        self.values: dict[str, str] = {}
        self.measure: Callable[[], dict[str, str]] = dict  # values found for each report
        self.preparing = ""  # what it goes on without until that is ready
        self.scheduling = ""  # how its process goes before others, if that was asked for
        self._publisher = node.create_publisher(
            DiagnosticArray, "diagnostics", SENT, qos_overriding_options=overridable()
        )
        node.create_timer(1.0, self.report)
        self._first = node.create_timer(0.01, self._report_first)

    def published(self, topic: str, stamp: TimeMessage | None = None) -> None:
        """One message went out on ``topic``; with a stamp, its age counts as latency."""
        self._published[topic] += 1
        if stamp is not None:
            self._latencies.append(1e3 * self._age(nanoseconds_of(stamp)))

    def _age(self, stamp: int) -> float:
        age = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp)
        is_simulated = self._node.time_is_simulated
        if abs(age) < ANOTHER_CLOCK_S and not is_simulated:
            return age
        if not self._clock_differs and not is_simulated:
            self._clock_differs = True
            self._node.get_logger().warning(
                f"stamps are {abs(age):.1f} s {'old' if age > 0 else 'ahead'}, so they are of "
                f"another clock: latency counts from arrival"
            )
        return 1e-9 * (time.monotonic_ns() - self._node.arrived)

    def problem(self, kind: str, sentence: str) -> None:
        """Count a problem of that kind; one that goes on is logged ever more rarely."""
        self._problems[kind] += 1
        self._last_problem = sentence = shown(sentence)
        self._last_kind = kind
        now = time.monotonic()
        due, wait = self._next.get(kind, (now, REPEAT_S))
        if now >= due:
            self._next[kind] = now + wait, min(2 * wait, SAY_AT_LEAST_S)
            self._node.get_logger().warning(sentence)

    def problems(self, kind: str) -> int:
        """How many of that kind there were."""
        return self._problems[kind]

    def _report_first(self) -> None:
        self._first.cancel()
        self.report()

    def report(self) -> None:
        """Publish the report: once a second, and at once when it is urgent."""
        now = time.monotonic()
        total = max(self._published.values(), default=0)
        rate = (total - self._last_total) / max(now - self._last_time, 1e-9)
        self._last_time, self._last_total = now, total
        failures = self._node.failures
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
            **{f"failed {where}": str(n) for where, n in failures.items()},
            **self.values,
            **self.measure(),
        }
        if self._latencies:
            p50, p99 = np.percentile(self._latencies, [50, 99])
            values |= {"latency_p50_ms": f"{p50:.2f}", "latency_p99_ms": f"{p99:.2f}"}
        ahead = -min(self._latencies, default=0.0)
        skew = (
            f"stamps are up to {ahead:.1f} ms ahead of this computer's clock, so no latency is "
            f"right: synchronise the computers' clocks, with chrony or PTP"
        )
        synchronous = ahead < 1.0  # ms; on a local network chrony does better
        wrong = self.fault or self._last_problem or self.warning or ("" if synchronous else skew)
        level = DiagnosticStatus.WARN if wrong else DiagnosticStatus.OK
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if self.fault else level,
            name=self._node.get_fully_qualified_name(),
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        if failures.total() > self._failures_told:
            self._failures_told, wrong = failures.total(), self._node.last_failure
            status.level = DiagnosticStatus.ERROR
        status.message = wrong or self.state
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
        self._last_problem = ""
