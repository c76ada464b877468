"""A private context with an executor, for tests that run against any rclpy."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node


class Bench:
    """Nodes in one context, and an executor that runs until a condition holds."""

    def __init__(self, args: list[str] | None = None) -> None:
        self.context = Context()
        rclpy.init(context=self.context, args=args or [])
        self.executor = SingleThreadedExecutor(context=self.context)
        self._nodes: list[Node] = []

    def node(self, name: str = "probe", **options: Any) -> Node:
        node = Node(name, context=self.context, **options)
        self.executor.add_node(node)
        self._nodes.append(node)
        return node

    def spin_until(self, condition: Callable[[], Any], seconds: float = 10.0) -> bool:
        """Run callbacks until the condition holds; False if it does not within the time."""
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)
        return bool(condition())

    def result(self, future: Any) -> Any:
        """The result of a future, once it is done."""
        assert self.spin_until(future.done)
        return future.result()

    def close(self) -> None:
        self.executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


@pytest.fixture
def bench_with() -> Iterator[Callable[[str | list[str]], Bench]]:
    """A function from a command line to a bench whose context has it."""
    made: list[Bench] = []

    def make(args: str | list[str]) -> Bench:
        made.append(Bench(args.split() if isinstance(args, str) else args))
        return made[-1]

    yield make
    for bench in made:
        bench.close()
