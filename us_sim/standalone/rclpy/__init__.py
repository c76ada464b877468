"""The subset of rclpy that this project's nodes use, without ROS 2.

`us_sim.standalone.install()` makes it importable as `rclpy` where the real one is not installed.
Names, arguments, defaults and errors are those of rclpy 7.1 (Jazzy).
"""

import inspect
from typing import Any

from .context import (
    Context,
    SignalHandlerOptions,
    get_default_context,
    get_rmw_implementation_identifier,
    install_signal_handlers,
    ok,
    try_shutdown,
    uninstall_signal_handlers,
)
from .context import shutdown as _shutdown
from .executors import Executor, SingleThreadedExecutor
from .node import Node
from .parameter import Parameter
from .task import Future

__all__ = [
    "Context",
    "Future",
    "Parameter",
    "SignalHandlerOptions",
    "create_node",
    "get_default_context",
    "get_global_executor",
    "get_rmw_implementation_identifier",
    "init",
    "install_signal_handlers",
    "ok",
    "shutdown",
    "spin",
    "spin_once",
    "spin_until_future_complete",
    "try_shutdown",
    "uninstall_signal_handlers",
]

_global_executor: Executor | None = None


def init(
    *,
    args: list[str] | None = None,
    context: Context | None = None,
    domain_id: int | None = None,
    signal_handler_options: SignalHandlerOptions | None = None,
) -> None:
    """Start; a default context is shut down by signals unless told otherwise."""
    context = get_default_context() if context is None else context
    if signal_handler_options is None:
        is_default = context is get_default_context()
        signal_handler_options = SignalHandlerOptions.ALL if is_default else SignalHandlerOptions.NO
    context.init(args, domain_id=domain_id)
    install_signal_handlers(signal_handler_options)


def get_global_executor() -> Executor:
    """The executor that `spin` and the like use when none is given."""
    global _global_executor
    if _global_executor is None:
        _global_executor = SingleThreadedExecutor()
        get_default_context().on_shutdown(_end_global_executor)
    return _global_executor


def _end_global_executor() -> None:
    global _global_executor
    executor, _global_executor = _global_executor, None
    if executor is not None:
        executor.shutdown()


def shutdown(*, context: Context | None = None, uninstall_handlers: bool | None = None) -> None:
    """Stop: executors end, nodes leave the network."""
    is_default = context is None or context is get_default_context()
    _shutdown(context=context)
    if uninstall_handlers or (uninstall_handlers is None and is_default):
        uninstall_signal_handlers()


def create_node(node_name: str, **arguments: Any) -> Node:
    return Node(node_name, **arguments)


create_node.__signature__ = inspect.signature(Node)  # type: ignore[attr-defined]


def spin_once(
    node: Node, *, executor: Executor | None = None, timeout_sec: float | None = None
) -> None:
    """Run one callback of a node, waiting for one to be ready until the time is over."""
    executor = get_global_executor() if executor is None else executor
    try:
        executor.add_node(node)
        executor.spin_once(timeout_sec=timeout_sec)
    finally:
        executor.remove_node(node)


def spin(node: Node, executor: Executor | None = None) -> None:
    """Run a node's callbacks until the context is shut down."""
    executor = get_global_executor() if executor is None else executor
    try:
        executor.add_node(node)
        while executor.context.ok():
            executor.spin_once()
    finally:
        executor.remove_node(node)


def spin_until_future_complete(
    node: Node, future: Future, executor: Executor | None = None, timeout_sec: float | None = None
) -> None:
    """Run a node's callbacks until a future is done, or the time is over."""
    executor = get_global_executor() if executor is None else executor
    added = False
    try:
        added = executor.add_node(node)
        executor.spin_until_future_complete(future, timeout_sec)
    finally:
        if added:
            executor.remove_node(node)
