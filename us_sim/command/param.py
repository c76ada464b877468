"""The command `us-sim param`: list, get and set like `ros2 param`, also without ros2cli.

`us-sim reference NODE` says what parameters mean.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from us_sim.command.options import add_network_option
from us_sim.errors import UsSimError
from us_sim.settings.spelling import describe_unknown
from us_sim.settings.text_files import YamlError, load_yaml

DISCOVERY_S = 7.0  # to discover a node: Fast DDS may miss an announcement, and repeats it after 3 s
ALL_S = 3.5  # to discover all of them
ANSWER_S = 5.0  # for a node to answer

_TYPES = (  # by rcl_interfaces/msg/ParameterType
    "not set", "boolean", "integer", "double", "string",
    "byte array", "boolean array", "integer array", "double array", "string array",
)  # fmt: skip


def param_options(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of `us-sim param`."""
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, command, arguments, text in (
        ("list", _list, ("node?",), "names of a node's parameters, or of those of all nodes"),
        ("get", _get, ("node", "name"), "value of a parameter"),
        ("set", _set, ("node", "name", "value"), "set a parameter; floats need a decimal point"),
    ):
        subparser = commands.add_parser(name, help=text)
        for argument in arguments:
            subparser.add_argument(argument.rstrip("?"), nargs="?" if "?" in argument else None)
        add_network_option(subparser)
        subparser.set_defaults(command=partial(_run, command))


def _run(command: Callable[[_Asker, argparse.Namespace], int], args: argparse.Namespace) -> int:
    from us_sim.run.processes import prepare_ros

    prepare_ros(network=args.network)
    from us_sim.run.domain import make_ros_context

    context = make_ros_context()
    try:
        with contextlib.closing(_Asker(context)) as asker:
            return command(asker, args)
    finally:
        context.try_shutdown()


def _list(asker: _Asker, args: argparse.Namespace) -> int:
    for node in asker.discover_nodes() if args.node is None else [asker.find_node(args.node)]:
        try:
            names = [f"  {name}" for name in asker.list_parameters(node)]
        except UsSimError as error:
            if args.node is not None:
                raise
            print(error, file=sys.stderr)
            continue
        print("\n".join(names if args.node is not None else [f"{node}:", *names]))
    return 0


def _get(asker: _Asker, args: argparse.Namespace) -> int:
    from rclpy.parameter import parameter_value_to_python

    node = asker.find_node(args.node)
    values = asker.ask_node(node, "get_parameters", [args.name]).values
    if not values:
        asker.refuse_unknown(node, args.name)
        raise UsSimError(f"{args.name} of {node} is not set")
    kind, _, is_array = _TYPES[values[0].type].partition(" ")
    label = f"{kind.capitalize()} {'values are' if is_array else 'value is'}:"
    print(label, parameter_value_to_python(values[0]))
    return 0


def _set(asker: _Asker, args: argparse.Namespace) -> int:
    value: Any = None
    with contextlib.suppress(YamlError):  # a text with a colon, say
        value = load_yaml(args.value)
    node = asker.find_node(args.node)
    is_text = value is None or isinstance(value, dict)
    result = asker.set_parameter(node, args.name, args.value if is_text else value)
    reason = f": {result.reason}" if result.reason else ""
    if not result.successful:
        asker.refuse_unknown(node, args.name)
        raise UsSimError(f"Setting parameter failed{reason}")
    print(f"Set parameter successful{reason}")
    return 0


class _Asker:
    """A hidden node that asks others for their parameters."""

    def __init__(self, context: Any) -> None:
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node

        self._node = Node(
            f"_us_sim_param_{os.getpid()}",
            context=context,
            enable_rosout=False,
            start_parameter_services=False,
            use_global_arguments=False,
        )
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self._node)

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()

    def discover_nodes(self, wanted: str = "", seconds: float = ALL_S) -> list[str]:
        """Look for nodes until the time is over, or the wanted one is there.

        Returns:
            the full names of all nodes but hidden ones, sorted.
        """
        until = time.monotonic() + seconds
        while True:
            found = self._node.get_node_names_and_namespaces()
            seen = sorted(f"{space.rstrip('/')}/{name}" for name, space in found if name[0] != "_")
            if wanted in seen or time.monotonic() > until:
                return seen
            self._executor.spin_once(timeout_sec=0.05)

    def find_node(self, name: str) -> str:
        """Return the full name of a node; raise UsSimError if it is not discovered."""
        full = name if name.startswith("/") else f"/{name}"
        seen = self.discover_nodes(full, DISCOVERY_S)
        if full in seen:
            return full
        domain = self._node.context.get_domain_id()
        nobody = f"{full}; there is no node on ROS domain {domain}, as far as can be seen from here"
        raise UsSimError(f"node not found: {describe_unknown(full, seen) if seen else nobody}")

    def list_parameters(self, node: str) -> list[str]:
        return sorted(self.ask_node(node, "list_parameters").result.names)

    def set_parameter(self, node: str, name: str, value: Any) -> Any:
        """Set a parameter; send a value without a type of ROS as a text."""
        from rclpy.parameter import Parameter

        try:
            parameter = Parameter(name, value=value)
        except (TypeError, ValueError):  # a mapping, or a list of several types
            parameter = Parameter(name, value=str(value))
        return self.ask_node(node, "set_parameters", [parameter]).results[0]

    def ask_node(self, node: str, request: str, *arguments: Any) -> Any:
        """Return a node's answer; raise UsSimError if none comes."""
        from rclpy.parameter_client import AsyncParameterClient

        client = AsyncParameterClient(self._node, node)
        if not client.wait_for_services(timeout_sec=ANSWER_S):
            raise UsSimError(f"{node} offers no parameter services")
        answer = getattr(client, request)(*arguments)
        self._executor.spin_until_future_complete(answer, timeout_sec=ANSWER_S)
        if not answer.done():
            raise UsSimError(f"{node} did not answer within {ANSWER_S:g} s")
        return answer.result()

    def refuse_unknown(self, node: str, name: str) -> None:
        """Raise UsSimError if the node has no such parameter."""
        known = self.list_parameters(node)
        if name not in known:
            raise UsSimError(f"{node} has no such parameter: {describe_unknown(name, known)}")
