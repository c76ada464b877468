"""A node that goes on after bad input and failures, and reports its health."""

from __future__ import annotations

import functools
import os
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType, ROSClock
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from us_sim.errors import UsSimError, printable_line
from us_sim.nodes import explain_ros_error
from us_sim.nodes.qos import EVERY, LATCHED, SENT, STREAM
from us_sim.recording.decoding import nanoseconds_of

T = TypeVar("T")
CLOCK_S = 5.0  # for simulated time to begin, before it is said that it does not
FAILED = "it failed; see the node's log"
ANOTHER_CLOCK_S = 10.0  # between the present and a stamp, from which on it is of another clock
LONGEST = 500  # characters of a sentence: an error may quote all of a message
REPEAT_S, SAY_AT_LEAST_S = 5.0, 300.0
"""Time until a problem is logged again: at first, then twice as long each time, and at most."""


class GuardedNode(Node):
    """A node whose callbacks are guarded: an exception ends neither this node nor others.

    Bad input, an error of this package, is *refused*: logged, and counted by its kind. Any other
    exception is a *failure*: logged, and counted by the callback that raised it. `Health` puts both
    in diagnostics.
    """

    lockstep = False  # every message is worked on, in order

    def __init__(self, name: str, **kwargs: Any) -> None:
        self.failures: Counter[str] = Counter()
        self.last_failure = ""
        self.arrived = time.monotonic_ns()  # of what is being worked on, by the monotonic clock
        self._due: dict[str, tuple[float, float]] = {}  # s: when to say it again, and then when
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        try:
            super().__init__(name, **kwargs)
        except RuntimeError as error:  # an RCLError
            raise explain_ros_error(error) from error
        self.health = Health(self)
        if self.is_time_simulated:
            self._clockless = self.create_timer(CLOCK_S, self._check_clock)

    @property
    def is_time_simulated(self) -> bool:
        """True if the node's time is that of ``/clock``."""
        clock = self.get_clock()
        return isinstance(clock, ROSClock) and clock.ros_time_is_active

    def _check_clock(self) -> None:
        """Warn if simulated time has not begun."""
        self._clockless.cancel()
        if not self.get_clock().now().nanoseconds:
            self.get_logger().warning(
                "use_sim_time is true, and nothing has come on /clock: this node's time stands at "
                "0; start what publishes it, or set use_sim_time to false"
            )

    def subscribe(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile = STREAM,
        *,
        newest: bool = False,
        raw: bool = False,
    ) -> Subscription:
        """Call ``callback``, guarded, with the messages of ``topic``.

        An executor takes one message of a subscription per turn, so a slow callback would fall
        behind a fast publisher. With ``newest`` the callback gets the last of all that wait, and
        the others are counted as dropped. In lockstep it gets every message.

        Args:
            message_type: of rclpy.
            topic: its quality of service may be overridden by parameters.
            callback: what it raises is logged and counted under the topic's name.
            qos: in lockstep, but for latched topics, it is `EVERY`.
            newest: skip older messages.
            raw: give the callback serialized messages.
        """
        is_latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        if self.lockstep and not is_latched:
            qos = EVERY
        where = self.resolve_topic_name(topic)
        queue = NewestQueue(self) if newest and not self.lockstep else None

        def on_message(message: Any) -> None:
            self.health.received += not is_latched
            callback(queue.drain_to_newest(subscription, message) if queue else message)

        subscription: Subscription = self.create_subscription(
            *(message_type, topic, self.guard_callback(where, on_message), qos),
            raw=raw,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        return subscription

    def handle_error(self, where: str, error: Exception) -> None:
        """Report bad input or a failure; raise the error again while the node is being ended."""
        if isinstance(error, ExternalShutdownException) or not self.context.ok():
            raise error
        if isinstance(error, UsSimError):
            self.report_bad_input(where, error)
        else:
            self.report_failure(where, error)

    def report_bad_input(self, where: str, error: UsSimError) -> None:
        """Count and log input that cannot be used."""
        self.health.count_problem(error_kind(error), f"{where}: {error}; it is not used")

    def report_failure(self, where: str, error: Exception) -> None:
        """Count and log an unexpected exception; any thread may call this."""
        self.failures[where] += 1
        self.last_failure = loggable_text(f"{where}: {type(error).__name__}: {error}")
        if self.is_log_due(where):
            self.get_logger().error(
                f"{self.last_failure}; the node goes on (failure {self.failures[where]} of this "
                f"kind; the traceback is at log level debug)"
            )
            self.get_logger().debug("".join(traceback.format_exception(error)))

    def is_log_due(self, kind: str) -> bool:
        """Return whether to log a problem of this kind now; it is logged ever more rarely."""
        now = time.monotonic()
        due, wait = self._due.get(kind, (now, REPEAT_S))
        if now < due:
            return False
        self._due[kind] = now + wait, min(2 * wait, SAY_AT_LEAST_S)
        return True

    def guard_callback(self, where: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return the callback guarded: it returns None in place of raising an exception.

        Args:
            where: name of the service, timer, ... in reports.
            callback: may raise only while the node is being ended.
        """

        @functools.wraps(callback)  # rclpy looks at its arguments
        def call(*arguments: Any) -> Any:
            self.arrived = time.monotonic_ns()
            try:
                return callback(*arguments)
            except Exception as error:
                self.handle_error(where, error)
                return None

        return call

    def create_stream_publisher(
        self, message_type: Any, topic: str, qos: QoSProfile = SENT
    ) -> Publisher:
        """Create a publisher whose quality of service may be overridden by parameters."""
        overrides = QoSOverridingOptions.with_default_policies()
        return self.create_publisher(message_type, topic, qos, qos_overriding_options=overrides)

    def create_latched_publisher(self, message_type: Any, topic: str) -> Publisher:
        """Create a publisher of messages that are kept for later subscribers."""
        return self.create_stream_publisher(message_type, topic, LATCHED)

    def create_timer(self, timer_period_sec: float, callback: Any, *args: Any, **kw: Any) -> Any:
        """Create a guarded timer, by real time unless a clock is given.

        So reports go on while simulated time stands.
        """
        call = self.guard_callback(f"timer {_name(callback)}", callback)
        return super().create_timer(timer_period_sec, call, *args, **{"clock": self._steady, **kw})

    def call_soon(self, callback: Callable[[], Any], where: str = "") -> None:
        """Have the executor call ``callback``, guarded; any thread may call this."""
        if self.executor is not None:  # else it has ended, or has not begun
            self.executor.create_task(self.guard_callback(where or _name(callback), callback))

    def create_newest_handler(self, use: Callable[[T], None], where: str) -> Callable[[T], None]:
        """Return a function by which a device's thread hands its newest value to the node's.

        Args:
            use: called with the value in the node's thread; older values are dropped.
            where: name of the thread in reports.
        """
        newest: deque[T] = deque(maxlen=1)

        def use_newest() -> None:
            if newest:
                use(newest.pop())

        def put(value: T) -> None:
            self.health.received += 1
            self.health.dropped += len(newest)
            newest.append(value)
            self.call_soon(use_newest, where)

        return put

    def create_command(self, name: str, act: Callable[[], str]) -> None:
        """Offer a command without parameters as the service ``~/name`` of type std_srvs/Trigger.

        Args:
            name: below the node's own.
            act: does it; returns a sentence on why it cannot be done, or nothing.
        """

        def answer(_: Any, response: Any) -> Any:
            problem = self.guard_callback(f"service {name}", act)()
            response.message = FAILED if problem is None else problem
            response.success = problem == ""
            return response

        self.create_service(Trigger, f"~/{name}", answer)


class NewestQueue:
    """The queue of a subscription whose newest message alone is worked on.

    Messages that a full queue has overwritten are counted by the publisher's numbers. rclpy's
    EventsExecutor does not hand these to a callback, but messages taken from the queue have them.
    """

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._taken = 0  # messages so far
        self._last: tuple[int, int] | None = None  # a number, and how many were taken by then

    def drain_to_newest(self, subscription: Subscription, message: Any) -> Any:
        """Take all messages that wait behind ``message``; return the last, count the others."""
        self._taken += 1
        health = self._node.health
        newest: tuple[Any, dict[str, Any]] = message, {}
        with subscription.handle:
            for _ in range(subscription.qos_profile.depth):
                further = subscription.handle.take_message(subscription.msg_type, subscription.raw)
                if further is None:
                    break
                newest = further
                self._taken += 1
                health.received += 1
                health.dropped += 1
        message, info = newest
        number = info.get("publication_sequence_number")  # not every middleware has it
        if number is not None:
            before, self._last = self._last, (number, self._taken)
            is_alone = self._node.count_publishers(subscription.topic_name) == 1
            if before and number > before[0] and is_alone:
                health.dropped += max(number - before[0] - (self._taken - before[1]), 0)
        return message


class Subscriptions:
    """Subscriptions that exist all together, or not at all.

    Args:
        node: that subscribes.
        wanted: type, topic, callback and quality of service; True for serialized messages.
    """

    def __init__(self, node: GuardedNode, *wanted: tuple[Any, str, Any, QoSProfile, bool]) -> None:
        self._node, self._wanted = node, wanted
        self._active: list[Any] = []

    def set_active(self, is_wanted: bool) -> bool:
        """Subscribe, or end the subscriptions; return whether that is a change."""
        if is_wanted == bool(self._active):
            return False
        for subscription in self._active:
            self._node.destroy_subscription(subscription)
        self._active = []
        for kind, topic, callback, qos, raw in self._wanted if is_wanted else ():
            self._active.append(self._node.subscribe(kind, topic, callback, qos, raw=raw))
        return True


def keep_newest(values: dict[Any, Any], key: Any, value: Any, most: int) -> None:
    """Keep a value as the newest; drop the oldest beyond ``most``."""
    values.pop(key, None)
    values[key] = value
    if len(values) > most:
        del values[next(iter(values))]


def error_kind(error: UsSimError) -> str:
    """Return the kind by which an error is counted: ``pose`` for a PoseError."""
    return type(error).__name__.removesuffix("Error").lower()


def _name(callback: Any) -> str:
    return getattr(callback, "__qualname__", type(callback).__name__)


def loggable_text(sentence: str) -> str:
    """Return a sentence, which may quote a message, on one line of limited length."""
    return printable_line(" ".join(sentence[: LONGEST + 1].split()), LONGEST)


def status_message(
    name: str, message: str, values: Mapping[str, Any], hardware_id: str, level: bytes
) -> DiagnosticStatus:
    """Make a status of diagnostics with values as text."""
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        level=level, name=name, message=message, hardware_id=hardware_id, values=pairs
    )


class Health:
    """Counts of a node's work, published on ``diagnostics`` at 1 Hz.

    Its level is ERROR during a fault that keeps the node from its work and after a failure, WARN
    while something else is wrong and after bad input, and otherwise OK.

    Latency is the age of a published message by its stamp. Under simulated time, and if stamps are
    of another clock, as those of a recording, it counts from the arrival of the message that it was
    made from. An age below zero is a clock that is wrong, on this computer or another one.

    Args:
        node: whose clock, logger and timer are used.
        hardware_id: the scene's name, or what else the node works on; None publishes nothing.
    """

    def __init__(self, node: GuardedNode, hardware_id: str | None = None) -> None:
        self._node = node
        self._hardware_id = hardware_id or ""
        self._latencies: deque[float] = deque(maxlen=1000)  # ms
        self._published: Counter[str] = Counter()
        self.problems: Counter[str] = Counter()  # by kind
        self._last_problem = self._last_kind = ""
        self.warning = ""  # what is wrong at present
        self.fault = ""  # the same, if it keeps the node from its work
        self._failures_told = 0
        self._clock_differs = False
        self._last_total, self._last_time = 0, time.monotonic()
        self.state = "starting"
        self.received = self.dropped = 0  # messages
        self.values: dict[str, str] = {}
        self.measure: Callable[[], dict[str, str]] = dict  # values found for each report
        self.preparing = ""  # what is not ready yet
        self.scheduling = ""  # of its process, `realtime` or `ordinary`, if it asked for the former
        if hardware_id is not None:
            self._publisher = node.create_stream_publisher(DiagnosticArray, "diagnostics")
            node.create_timer(1.0, self.publish_report)
            self._first = node.create_timer(0.01, self._report_first)

    def count_published(self, topic: str, stamp: TimeMessage | None = None) -> None:
        """Count a message published on ``topic``; with a stamp, its age is a latency."""
        self._published[topic] += 1
        if stamp is not None:
            self._latencies.append(1e3 * self._age(nanoseconds_of(stamp)))

    def _age(self, stamp: int) -> float:
        age = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp)
        is_simulated = self._node.is_time_simulated
        if abs(age) < ANOTHER_CLOCK_S and not is_simulated:
            return age
        if not self._clock_differs and not is_simulated:
            self._clock_differs = True
            self._node.get_logger().warning(
                f"stamps are {abs(age):.1f} s {'old' if age > 0 else 'ahead'}, so they are of "
                f"another clock: latency counts from arrival"
            )
        return 1e-9 * (time.monotonic_ns() - self._node.arrived)

    def count_problem(self, kind: str, sentence: str) -> None:
        """Count and log a problem; one that goes on is logged ever more rarely."""
        self.problems[kind] += 1
        self._last_problem, self._last_kind = loggable_text(sentence), kind
        if self._node.is_log_due(kind):
            self._node.get_logger().warning(self._last_problem)

    def _report_first(self) -> None:
        self._first.cancel()
        self.publish_report()

    def publish_report(self) -> None:
        """Publish the report: a timer does so once a second, others at once if it is urgent."""
        node, now = self._node, time.monotonic()
        total = max(self._published.values(), default=0)
        rate = (total - self._last_total) / max(now - self._last_time, 1e-9)
        self._last_time, self._last_total = now, total
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
            **{f"rejected {kind}": str(n) for kind, n in self.problems.items()},
            **{f"failed {where}": str(n) for where, n in node.failures.items()},
            **self.values,
            **self.measure(),
        }
        if self._latencies:
            p50, p99 = np.percentile(self._latencies, [50, 99])
            values |= {"latency_p50_ms": f"{p50:.2f}", "latency_p99_ms": f"{p99:.2f}"}
        ahead = -min(self._latencies, default=0.0)  # on a local network chrony does better than 1
        skew = (
            f"stamps are up to {ahead:.1f} ms ahead of this computer's clock, so no latency is "
            f"right: synchronise the computers' clocks, with chrony or PTP"
        )
        wrong = self.fault or self._last_problem or self.warning or (skew if ahead >= 1.0 else "")
        has_failed = node.failures.total() > self._failures_told
        if has_failed:
            self._failures_told, wrong = node.failures.total(), node.last_failure
        level = DiagnosticStatus.WARN if wrong else DiagnosticStatus.OK
        level = DiagnosticStatus.ERROR if has_failed or self.fault else level
        name = node.get_fully_qualified_name()
        status = status_message(name, wrong or self.state, values, self._hardware_id, level)
        message = DiagnosticArray(status=[status])
        message.header.stamp = node.get_clock().now().to_msg()
        self._publisher.publish(message)
        self._last_problem = ""
