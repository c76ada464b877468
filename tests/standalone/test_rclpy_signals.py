"""Ctrl-C and SIGTERM, in processes of their own."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import rclpy
from rclpy.signals import (
    SignalHandlerOptions,
    get_current_signal_handlers_options,
    install_signal_handlers,
    uninstall_signal_handlers,
)

pytestmark = pytest.mark.skipif(
    rclpy.__name__ == "rclpy",
    reason="the real rclpy sometimes fails or hangs when a signal meets it between two waits",
)

SPIN = """
import signal, sys, threading
import us_sim.nodes
import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.signals import SignalHandlerOptions

rclpy.init(args=[], signal_handler_options=getattr(SignalHandlerOptions, sys.argv[2]))
down = threading.Event()
rclpy.get_default_context().on_shutdown(down.set)
node = rclpy.create_node("probe")
executor = MultiThreadedExecutor(2) if sys.argv[1] == "threads" else None
say = lambda text: print(text, flush=True)
ready = node.create_timer(0.01, lambda: (ready.cancel(), say("ready")))
try:
    if sys.argv[1] == "busy":
        busy = node.create_timer(0.001, lambda: sum(range(100_000)))
    rclpy.spin(node, executor)
    say("ended")
except KeyboardInterrupt:
    say("KeyboardInterrupt")
except ExternalShutdownException:
    say("ExternalShutdownException")
down.wait(1.0)  # rclpy shuts down in a thread of its own
say("down" if not rclpy.ok() else "up")
node.destroy_node()
rclpy.try_shutdown()
"""


@contextmanager
def spinning(how: str, options: str = "ALL") -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-c", SPIN, how, options],
        env=dict(os.environ),
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("how", ["idle", "busy"])
@pytest.mark.parametrize(
    ("number", "raised"),
    [
        (signal.SIGINT, ("KeyboardInterrupt",)),
        # `spin` just ends when the signal comes while a callback runs.
        (signal.SIGTERM, ("ExternalShutdownException", "ended")),
    ],
)
def test_a_signal_ends_spinning_and_the_context(
    how: str, number: int, raised: tuple[str, ...]
) -> None:
    with spinning(how) as process:
        process.send_signal(number)
        out, _ = process.communicate(timeout=20)
        assert out.split() in [[how_it_ended, "down"] for how_it_ended in raised]
        assert process.returncode == 0


def test_many_threads_end_too() -> None:
    with spinning("threads") as process:
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=20)
        assert out.split() == ["ended", "down"]
        assert process.returncode == 0


def test_without_handlers_a_signal_does_what_python_does() -> None:
    with spinning("idle", "NO") as process:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=20)
        assert process.returncode == -signal.SIGTERM


def test_handlers_are_installed_and_given_back() -> None:
    options = SignalHandlerOptions
    before = signal.getsignal(signal.SIGINT)
    assert get_current_signal_handlers_options() == options.NO
    install_signal_handlers(options.SIGTERM)
    assert get_current_signal_handlers_options() == options.SIGTERM
    install_signal_handlers(options.SIGINT)
    assert get_current_signal_handlers_options() == options.ALL
    uninstall_signal_handlers()
    assert get_current_signal_handlers_options() == options.NO
    assert signal.getsignal(signal.SIGINT) is before
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
