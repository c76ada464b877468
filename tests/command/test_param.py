"""The command `us-sim param` against a running node; the outputs are those of ros2cli's verbs.

They were compared byte for byte with what ros2param of Jazzy prints for the same node.
"""

import threading

import pytest
import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from us_sim.command.main import main


@pytest.fixture(scope="module", autouse=True)
def node():
    context = Context()
    rclpy.init(context=context, args=[])
    node = Node("sample", namespace="left", context=context)
    limits = [FloatingPointRange(from_value=1.0, to_value=60.0)]
    node.declare_parameter(
        "rate", 30.0, ParameterDescriptor(description="how often, Hz", floating_point_range=limits)
    )
    steps = [IntegerRange(from_value=0, to_value=10, step=1)]
    node.declare_parameter("deep.count", 3, ParameterDescriptor(integer_range=steps))
    node.declare_parameter("names", ["vein", "artery"])
    node.declare_parameter("numbers", [1, 2])
    node.declare_parameter("fixed", "x", ParameterDescriptor(read_only=True))
    node.declare_parameter("on", True)
    node.declare_parameter("small", 1e-06)
    node.declare_parameter("word", "x")
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()
    yield node
    executor.shutdown()
    thread.join(timeout=5)
    node.destroy_node()
    context.try_shutdown()


NAMES = "  deep.count\n  fixed\n  names\n  numbers\n  on\n  rate\n  small\n"
NAMES += "  start_type_description_service\n  use_sim_time\n  word\n"


@pytest.mark.parametrize(
    ("words", "printed"),
    [
        ("list left/sample", NAMES),
        ("get /left/sample names", "String values are: ['vein', 'artery']\n"),
        ("get /left/sample on", "Boolean value is: True\n"),
    ],
)
def test_parameters_are_shown_as_ros2_param_shows_them(words, printed, capsys) -> None:
    assert main(["param", *words.split()]) == 0
    assert capsys.readouterr().out == printed


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("names", "[a, b]", ["a", "b"]),
        ("on", "false", False),
        ("word", '{"a": 1}', '{"a": 1}'),
    ],
)
def test_a_value_is_set_by_its_yaml(node, name, text, value, capsys) -> None:
    before = node.get_parameter(name)
    assert main(["param", "set", "/left/sample", name, text]) == 0
    assert capsys.readouterr().out == "Set parameter successful\n"
    assert node.get_parameter(name).value == value
    node.set_parameters([before])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("get /left/sampel rate", "node not found: '/left/sampel' is not one of /left/sample; did"),
        ("set /left/sample ratee 1.0", "did you mean 'rate'?"),
        ("set /left/sample rate 99.0", "Setting parameter failed: Parameter rate out of range"),
    ],
)
def test_a_mistake_is_one_sentence(words, sentence, capsys) -> None:
    assert main(["param", *words.split()]) == 1
    told = capsys.readouterr()
    assert sentence in told.err
    assert told.err.count("\n") == 1
    assert not told.out
