"""Parameters as pages show them: units there and back, nothing, and values that are none.

The parameters of other nodes: read, followed and set, of ours and of any others.
"""

import asyncio
import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

import pytest
from bench import Bench
from hypothesis import given
from hypothesis import strategies as st
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from us_sim.errors import SettingsError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.settings import TissueDeformerSettings
from us_sim.settings.quantity import Quantity, choose_dial_unit, units_of
from us_sim.settings.registry import SOLVERS
from us_sim.slicing.settings import ColourSettings, Imaging
from us_sim.viewer.parameters import Parameter, ParameterKind
from us_sim.viewer.remote_parameters import (
    ABSENT,
    SILENT,
    THERE,
    NodeParameters,
    RemoteParameters,
)

QUANTITIES = [
    Quantity("length", 1e-4, 0.4),
    Quantity("pressure", 1.0, 1e13),
    Quantity("angle", math.radians(1), math.radians(89)),
    Quantity("frequency", 5e5, 5e7),
    Quantity("rate", 0.02, 5.0),
    Quantity("speed", 0.01, 5.0),
    Quantity("acoustic impedance", 100.0, 1e8),
    Quantity("level", -60.0, 60.0),
    Quantity("number", -0.99, 0.49999),
]


def parameter(quantity: Quantity, raw: float = 0.0, **fields: object) -> Parameter:
    unit = choose_dial_unit(quantity)
    size = units_of(quantity.unit).get(unit, 1.0)
    limits = quantity.minimum, quantity.maximum
    return Parameter(
        "n", "x", ParameterKind.NUMBER, raw, unit=unit, size=size, limits=limits, **fields
    )


@pytest.mark.parametrize(
    ("quantity", "raw", "shown", "unit"),
    [
        (QUANTITIES[0], 0.007, 7.0, "mm"),
        (QUANTITIES[1], 12_500.0, 12.5, "kPa"),
        (QUANTITIES[2], math.pi / 3, 60.0, "deg"),
        (QUANTITIES[4], 1.1, 66.0, "/min"),
        (QUANTITIES[7], -6.0, -6.0, "dB"),
        (QUANTITIES[8], 0.45, 0.45, ""),
    ],
)
def test_a_number_is_shown_in_the_unit_that_people_read(quantity, raw, shown, unit):
    made = parameter(quantity, raw)
    assert (made.value, made.unit) == (shown, unit)
    assert made.convert_to_raw(shown) == pytest.approx(raw, rel=1e-15)


def test_a_handy_number_of_millimetres_is_the_float_that_a_person_would_write():
    made = parameter(QUANTITIES[0])
    assert [made.convert_to_raw(n) for n in (0.3, 1, 7, 40, 55)] == [
        0.0003,
        0.001,
        0.007,
        0.04,
        0.055,
    ]


@given(st.sampled_from(QUANTITIES), st.floats(0.0, 1.0))
def test_what_is_shown_comes_back_as_it_was(quantity, share):
    raw = quantity.minimum + share * (quantity.maximum - quantity.minimum)
    made = parameter(quantity, raw)
    assert made.low <= made.value <= made.high
    back = made.convert_to_raw(made.value)
    assert math.isclose(back, raw, rel_tol=2e-11, abs_tol=1e-300)
    assert quantity.minimum <= back <= quantity.maximum
    assert made.with_raw(back).value == pytest.approx(made.value, rel=2e-11)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_ends_of_a_range_will_do_although_they_were_rounded(quantity):
    made = parameter(quantity)
    assert made.convert_to_raw(made.low) == quantity.minimum
    assert made.convert_to_raw(made.high) == quantity.maximum


@pytest.mark.parametrize(
    ("kind", "raw", "nothing"),
    [
        (ParameterKind.NUMBER, 3.5, 0.0),
        (ParameterKind.TEXT, "fem", ""),
        (ParameterKind.NUMBERS, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0)),
    ],
)
def test_nothing_is_the_value_that_parameters_have_for_it(kind, raw, nothing):
    made = Parameter("n", "x", kind, raw, may_be_nothing=True)
    assert made.value == raw
    assert made.convert_to_raw(None) == nothing
    assert made.with_raw(nothing).value is None
    with pytest.raises(SettingsError, match="x needs a value"):
        Parameter("n", "x", kind, raw).convert_to_raw(None)


@pytest.mark.parametrize(
    ("kind", "value", "word"),
    [
        (ParameterKind.NUMBER, "much", "not a number"),
        (ParameterKind.NUMBER, math.nan, "not a number"),
        (ParameterKind.NUMBER, -3.5, "-3.5 mm is outside 5 to 400 mm"),
        (ParameterKind.WHOLE, 1.5, "not a whole number"),
        (ParameterKind.WHOLE, 1e19, "whole number below"),
        (ParameterKind.TRUTH, 3, "3 is not what"),
        (ParameterKind.NUMBERS, [1, "x"], "'x' is not a number"),
        (ParameterKind.OTHER, 3, "3 is not what"),
    ],
)
def test_what_is_no_value_is_refused_in_a_sentence_in_the_unit_that_is_shown(kind, value, word):
    made = Parameter("n", "x", kind, 0, limits=(0.005, 0.4), unit="mm", size=1e-3)
    with pytest.raises(SettingsError, match=word):
        made.convert_to_raw(value)


def test_lists_are_numbers_in_the_unit_that_is_shown():
    made = Parameter("n", "x", ParameterKind.NUMBERS, (0.001, 0.02), unit="mm", size=1e-3)
    assert made.value == (1.0, 20.0)
    assert made.convert_to_raw(["3", 4]) == (0.003, 0.004)


class Pages:
    """An event loop that serves pages, beside the bench's thread, and the nodes that they show."""

    def __init__(self, bench: Bench, **setters: Any) -> None:
        self._bench = bench
        self.nodes = RemoteParameters(
            bench.add(GuardedNode("asking", context=bench.context)), setters
        )
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()

    def call(self, work: Callable[[], Any]) -> Any:
        """Have the loop do something while the bench spins; return its result."""

        async def done() -> Any:
            made = work()
            return await made if asyncio.iscoroutine(made) else made

        future = asyncio.run_coroutine_threadsafe(done(), self.loop)
        self._bench.spin_until(future.done)
        return future.result()

    def set(self, name: str, parameter: str, value: Any) -> str:
        return self.call(lambda: self.nodes.get_node(name).set_value(parameter, value))

    def look_at(self, name: str) -> NodeParameters:
        node = self.nodes.get_node(name)
        self.call(node.add_page)
        self._bench.spin_until(lambda: node.state == THERE)
        return node

    def close(self) -> None:
        async def end() -> None:
            others = asyncio.all_tasks() - {asyncio.current_task()}
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)

        # Not beside a spin: rclpy's executor fails where it waits for what is just destroyed.
        asyncio.run_coroutine_threadsafe(end(), self.loop).result(30.0)
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()


@pytest.fixture
def pages(bench: Bench) -> Iterator[Pages]:
    pages = Pages(bench)
    yield pages
    pages.close()


def console(bench: Bench, name: str = "console") -> Node:
    """A node of ours with settings that may change."""
    node = bench.add(Node(name, context=bench.context))
    LiveSettings(node, {"imaging": Imaging(), "colour.": ColourSettings()})
    return node


def heard(bench: Bench) -> None:
    """Let the pages' node and the events of parameters find each other."""
    bench.spin_until(lambda: bench.peer.count_subscribers("/parameter_events") > 0)
    bench.spin_for(5)


def end(bench: Bench, node: Node) -> None:
    """End a node, as its process would."""
    bench.executor.remove_node(node)
    bench._nodes.remove(node)
    node.destroy_node()


def test_a_node_of_ours_says_units_ranges_choices_and_meanings(bench, pages):
    node = console(bench)
    LiveSettings(node, {"own.": TissueDeformerSettings()})
    known = pages.look_at("console").parameters

    def said(name: str, *fields: str) -> list[Any]:
        return [getattr(known[name], field) for field in fields]

    gain = [ParameterKind.NUMBER, 0.0, "dB", -60.0, 60.0, "added to every echo", True]
    assert said("gain", "kind", "value", "unit", "low", "high", "description", "is_live") == gain
    assert said("elevation_width", "value", "unit") == [2.0, "mm"]
    depth = [None, True, "mm", 400.0]
    assert said("colour.depth", "value", "may_be_nothing", "unit", "high") == depth
    assert said("elevation_planes", "kind", "value", "high") == [ParameterKind.WHOLE, 1, 15]
    assert said("grey_map", "choices") == [("linear", "soft", "contrast")]
    assert said("contact", "value") == [False]
    assert said("time_gain", "value") == [(0.0,)]
    assert said("colour.nyquist_velocity", "value", "unit") == [30.0, "cm/s"]
    assert said("colour.steering", "unit") == ["deg"]
    assert said("own.solver", "choices", "meanings") == [SOLVERS.names, SOLVERS.summaries]
    assert said("own.compare_with", "meanings") == [SOLVERS.summaries]


def test_a_value_is_set_in_the_unit_that_is_shown(bench, pages):
    node, shown = console(bench), pages.look_at("console")
    for name, value, raw in (
        ("elevation_width", 7, 0.007),
        ("time_gain", [0, 3, 6], [0.0, 3.0, 6.0]),
        ("colour.depth", 20, 0.02),
        ("colour.depth", None, 0.0),
        ("elevation_planes", 3, 3),
        ("grey_map", "soft", "soft"),
        ("contact", True, True),
    ):
        assert pages.set("console", name, value) == ""
        assert (
            node.get_parameter(name).get_parameter_value()
            == RosParameter(name, value=raw).get_parameter_value()
        )
    assert shown.parameters["elevation_width"].value == 7.0


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("gain", 99, "99 dB is outside"),
        ("grey_map", "purple", "'purple' is not one of linear, soft, contrast"),
        ("gian", 1, "no parameter gian"),
    ],
)
def test_a_refused_value_says_why_and_stays_what_it_was(bench, pages, name, value, word):
    console(bench)
    shown = pages.look_at("console")
    before = shown.parameters
    assert word in pages.set("console", name, value)
    assert shown.parameters == before


def test_a_change_made_elsewhere_reaches_the_page(bench, pages):
    node, shown = console(bench), pages.look_at("console")
    before = shown.parameters
    heard(bench)
    node.set_parameters([RosParameter("gain", value=6.0)])
    bench.spin_until(lambda: shown.parameters["gain"].value == 6.0)
    assert before["gain"].value == 0.0  # what was told is not changed
    node.declare_parameter("added_later", 3, ParameterDescriptor(dynamic_typing=True))
    bench.spin_until(lambda: "added_later" in shown.parameters)
    node.set_parameters([RosParameter("added_later")])
    bench.spin_until(lambda: "added_later" not in shown.parameters)


def test_a_node_that_goes_is_gone_and_one_that_restarts_is_read_anew(bench, pages):
    node, shown = console(bench), pages.look_at("console")
    end(bench, node)
    bench.spin_until(lambda: shown.state == ABSENT)
    assert not shown.parameters
    again = bench.add(Node("console", context=bench.context))
    again.declare_parameter("other", 2.5)
    bench.spin_until(lambda: set(shown.parameters) == {"other"})


def test_a_foreign_node_s_plain_descriptors_will_do(bench, pages):
    node = bench.add(Node("motor", context=bench.context))
    node.declare_parameter("speed", 3.5)
    node.declare_parameter("name", "left")
    node.declare_parameter(
        "reach",
        0.5,
        ParameterDescriptor(
            additional_constraints="one of many; in m",
            floating_point_range=[FloatingPointRange(from_value=0.0, to_value=2.0)],
        ),
    )
    about = ParameterDescriptor(description="a minute (rpm)", read_only=True)
    node.declare_parameter("turns", 1.0, about)
    node.declare_parameter("flags", [True, False])
    known = pages.look_at("motor").parameters
    assert (known["speed"].value, known["speed"].unit, known["speed"].low) == (3.5, "", None)
    assert known["name"].kind is ParameterKind.TEXT
    assert (known["reach"].value, known["reach"].unit, known["reach"].high) == (0.5, "", 2.0)
    assert (known["turns"].description, known["turns"].is_live) == ("a minute (rpm)", False)
    assert (known["flags"].kind, known["flags"].is_live) == (ParameterKind.OTHER, False)
    assert pages.set("motor", "speed", 4) == ""
    assert node.get_parameter("speed").value == 4.0
    node.add_on_set_parameters_callback(lambda _: SetParametersResult(successful=False))
    assert pages.set("motor", "speed", 5) == "motor refuses it"


def test_a_parameter_without_a_value_does_not_hide_the_others(bench, pages):
    node = bench.add(Node("motor", context=bench.context))
    node.declare_parameter("speed", 3.5)
    node.declare_parameter("torque", RosParameter.Type.DOUBLE)  # a type, and no value yet
    node.declare_parameter("any", None, ParameterDescriptor(dynamic_typing=True))
    shown = pages.look_at("motor")
    assert set(shown.parameters) == {"speed"}
    heard(bench)
    node.set_parameters([RosParameter("torque", value=1.5)])
    bench.spin_until(lambda: "torque" in shown.parameters)
    assert shown.parameters["torque"].value == 1.5


def test_a_node_without_parameter_services_is_silent(bench, pages, monkeypatch):
    monkeypatch.setattr("us_sim.viewer.remote_parameters.ANSWER_S", 0.1)
    bench.add(Node("mute", context=bench.context, start_parameter_services=False))
    shown = pages.nodes.get_node("mute")
    pages.call(shown.add_page)
    bench.spin_until(lambda: shown.state == SILENT)
    assert "no parameter" in pages.set("mute", "gain", 1)


def test_a_node_that_does_not_answer_is_told_so(bench, pages, monkeypatch):
    node = console(bench)
    pages.look_at("console")
    monkeypatch.setattr("us_sim.viewer.remote_parameters.ANSWER_S", 0.0)
    bench.executor.remove_node(node)  # it hangs
    assert pages.set("console", "gain", 3) == "console did not answer within 0 s"


def test_nothing_is_asked_while_nobody_looks(bench, pages):
    console(bench)
    shown = pages.look_at("console")
    pages.look_at("console")
    pages.call(shown.remove_page)
    heard(bench)
    pages.call(shown.remove_page)
    bench.spin_until(lambda: bench.peer.count_subscribers("/parameter_events") == 0)
    assert "gain" in pages.look_at("console").parameters  # read anew when somebody does again


def test_a_node_with_a_setter_is_set_by_that_alone(bench):
    asked: list[dict[str, Any]] = []
    refused: Future[str] = Future()
    refused.set_result("not from here")

    def ask(**values: Any) -> "Future[str]":
        asked.append(values)
        return refused

    node = console(bench)
    with contextlib.closing(Pages(bench, console=ask)) as pages:
        pages.look_at("console")
        assert pages.set("console", "gain", 3.0) == "not from here"
    assert asked == [{"gain": 3.0}]
    assert node.get_parameter("gain").value == 0.0
