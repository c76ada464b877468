"""The panels of real nodes: a parameter that a node declares has a control, in both directions."""

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from awaiting import until

from bench import Bench  # isort: skip
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.viewer.remote_parameters import RemoteParameters
from us_sim.viewer.stream import PageSources

NODE = "slice_interpolator"


@pytest.fixture
def graph(sources: PageSources) -> Iterator[Node]:
    """A node whose parameters the panels show, spun beside the test."""
    bench = Bench()
    node = bench.add(Node(NODE, context=bench.context))
    asking = bench.add(GuardedNode("viewer", context=bench.context))
    sources.nodes = RemoteParameters(asking)
    ended = threading.Event()

    def spin() -> None:
        while not ended.is_set():
            bench.executor.spin_once(timeout_sec=0.05)

    spinning = threading.Thread(target=spin)
    spinning.start()
    yield node
    ended.set()
    spinning.join()
    bench.close()


def test_what_a_node_declares_has_a_control(page: Any, graph: Node) -> None:
    graph.declare_parameter("gain", 1.0, ParameterDescriptor(description="added to echoes (dB)"))
    page.goto(page.address)
    page.get_by_role("button", name="Panels").click()
    gain = page.locator(f'[data-parameter="{NODE}.gain"] input')
    gain.wait_for()
    descriptor = ParameterDescriptor(
        description="of the gel",
        additional_constraints='{"unit": "m", "shown_in": "mm", "none": 0, "live": true}',
        floating_point_range=[FloatingPointRange(from_value=0.0, to_value=0.05)],
    )
    graph.declare_parameter("gel.thickness", 0.002, descriptor)
    page.get_by_role("button", name='Expand "Gel"').click()
    control = page.locator(f'[data-parameter="{NODE}.gel.thickness"]')
    field = control.locator("input")
    until(lambda: field.input_value() == "2", "the new parameter is shown in mm")
    field.fill("5")
    field.press("Enter")
    until(lambda: graph.get_parameter("gel.thickness").value == 0.005, "the node has it in m")
    graph.set_parameters([Parameter("gel.thickness", value=0.01)])
    until(lambda: field.input_value() == "10", "what is set elsewhere moves the control")
    sentence = "there is no gel left"
    graph.add_on_set_parameters_callback(
        lambda _: SetParametersResult(successful=False, reason=sentence)
    )
    field.fill("20")
    field.press("Enter")
    control.get_by_role("alert").wait_for()
    assert control.get_by_role("alert").inner_text() == sentence
    assert field.input_value() == "10"
