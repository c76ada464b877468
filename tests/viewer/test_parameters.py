"""Parameters as pages show them: units there and back, nothing, and values that are none.

The parameters of other nodes: read, followed and set, of ours and of any others.
"""

import math
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
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.settings import TissueDeformerSettings
from us_sim.settings.quantity import Quantity, dial_unit, units_of
from us_sim.settings.registry import SOLVERS
from us_sim.slicing.settings import ColourSettings, Imaging
from us_sim.viewer.parameters import Kind, Parameter, State, in_words
from us_sim.viewer.remote_parameters import RemoteParameters
from us_sim.viewer.stream import Posted

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
    unit = dial_unit(quantity)
    size = units_of(quantity.unit).get(unit, 1.0)
    limits = quantity.minimum, quantity.maximum
    return Parameter("n", "x", Kind.NUMBER, raw, unit=unit, size=size, limits=limits, **fields)


@pytest.mark.parametrize(
    ("quantity", "raw", "shown", "unit"),
    [
        (QUANTITIES[0], 0.04, 40.0, "mm"),
        (QUANTITIES[0], 0.007, 7.0, "mm"),
        (QUANTITIES[1], 12_500.0, 12.5, "kPa"),
        (QUANTITIES[2], math.pi / 3, 60.0, "deg"),
        (QUANTITIES[3], 7.5e6, 7.5, "MHz"),
        (QUANTITIES[4], 1.1, 66.0, "/min"),
        (QUANTITIES[5], 0.3, 30.0, "cm/s"),
        (QUANTITIES[6], 1.63e6, 1.63, "MRayl"),
        (QUANTITIES[7], -6.0, -6.0, "dB"),
        (QUANTITIES[8], 0.45, 0.45, ""),
    ],
)
def test_a_number_is_shown_in_the_unit_that_people_read(quantity, raw, shown, unit):
    made = parameter(quantity, raw)
    assert (made.value, made.unit) == (shown, unit)
    assert made.raw_of(shown) == pytest.approx(raw, rel=1e-15)


def test_a_handy_number_of_millimetres_is_the_float_that_a_person_would_write():
    made = parameter(QUANTITIES[0])
    assert [made.raw_of(n) for n in (0.3, 1, 7, 40, 55)] == [0.0003, 0.001, 0.007, 0.04, 0.055]


@given(st.sampled_from(QUANTITIES), st.floats(0.0, 1.0))
def test_what_is_shown_comes_back_as_it_was(quantity, share):
    raw = quantity.minimum + share * (quantity.maximum - quantity.minimum)
    made = parameter(quantity, raw)
    assert made.low <= made.value <= made.high
    back = made.raw_of(made.value)
    assert math.isclose(back, raw, rel_tol=2e-11, abs_tol=1e-300)
    assert quantity.minimum <= back <= quantity.maximum
    assert made.with_raw(back).value == pytest.approx(made.value, rel=2e-11)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_ends_of_a_range_will_do_although_they_were_rounded(quantity):
    made = parameter(quantity)
    assert made.raw_of(made.low) == quantity.minimum
    assert made.raw_of(made.high) == quantity.maximum


@pytest.mark.parametrize(
    ("kind", "raw", "nothing"),
    [
        (Kind.NUMBER, 3.5, 0.0),
        (Kind.WHOLE, 3, 0),
        (Kind.TEXT, "fem", ""),
        (Kind.NUMBERS, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0)),
    ],
)
def test_nothing_is_the_value_that_parameters_have_for_it(kind, raw, nothing):
    made = Parameter("n", "x", kind, raw, may_be_nothing=True)
    assert made.value == raw
    assert made.raw_of(None) == nothing
    assert made.with_raw(nothing).value is None
    with pytest.raises(SettingsError, match="x needs a value"):
        Parameter("n", "x", kind, raw).raw_of(None)


@pytest.mark.parametrize(
    ("kind", "value", "sentence"),
    [
        (Kind.NUMBER, "much", "'much' is not a number"),
        (Kind.NUMBER, math.nan, "nan is not a number"),
        (Kind.NUMBER, True, "True is not a number"),
        (Kind.NUMBER, "", "needs a value"),
        (Kind.WHOLE, 1.5, "1.5 is not a whole number"),
        (Kind.WHOLE, 1e19, "1e\\+19 is too large"),
        (Kind.TRUTH, 3, "3 is not what it can be set to"),
        (Kind.TEXT, 3, "3 is not what it can be set to"),
        (Kind.NUMBERS, [1, "x"], "'x' is not a number"),
        (Kind.NUMBERS, 3, "3 is not what it can be set to"),
        (Kind.OTHER, 3, "3 is not what it can be set to"),
    ],
)
def test_what_is_no_value_is_refused_in_a_sentence(kind, value, sentence):
    raw = {Kind.NUMBERS: ()}.get(kind, 0)
    with pytest.raises(SettingsError, match=f"focus depth.*{sentence}"):
        Parameter("n", "colour.focus_depth", kind, raw).raw_of(value)


@pytest.mark.parametrize(
    ("kind", "value", "sentence"),
    [
        (Kind.NUMBER, 900, "900 mm is outside 5 to 400 mm"),
        (Kind.NUMBER, -3.5, "-3.5 mm is outside 5 to 400 mm"),
        (Kind.WHOLE, 0, "0 is outside 1 to 15"),
    ],
)
def test_what_is_out_of_range_is_said_in_the_unit_that_is_shown(kind, value, sentence):
    whole = kind is Kind.WHOLE
    unit = {} if whole else {"unit": "mm", "size": 1e-3}
    made = Parameter("n", "x", kind, 1, limits=(1, 15) if whole else (0.005, 0.4), **unit)
    with pytest.raises(SettingsError, match=f"^{sentence}$"):
        made.raw_of(value)


def test_lists_are_numbers_in_the_unit_that_is_shown():
    made = Parameter("n", "x", Kind.NUMBERS, (0.001, 0.02), unit="mm", size=1e-3)
    assert made.value == (1.0, 20.0)
    assert made.raw_of(["3", 4]) == (0.003, 0.004)


def test_a_name_says_its_group_and_its_words():
    made = Parameter("n", "materials.fat.young_modulus", Kind.NUMBER, 1.0)
    assert (made.group, made.label) == ("materials.fat", "young modulus")


def test_names_are_written_as_in_the_field():
    assert Parameter("n", "colour.nyquist_velocity", Kind.TEXT, "").label == "Nyquist velocity"
    assert in_words("m_mode.lateral") == "M-mode · lateral"
    assert in_words("mode") == "mode"


@pytest.fixture
def remote(bench: Bench) -> RemoteParameters:
    """Parameters of others, as one node sees them."""
    asking = bench.add(GuardedNode("asking", context=bench.context))
    return RemoteParameters(asking, Posted(asking))


def console(bench: Bench, name: str = "console") -> Node:
    """A node of ours with settings that may change."""
    node = bench.add(Node(name, context=bench.context))
    LiveSettings(node, {"imaging": Group(Imaging()), "colour": Group(ColourSettings(), "colour.")})
    return node


def looked_at(bench: Bench, remote: RemoteParameters, name: str) -> dict[str, Any]:
    remote.watch(name)
    bench.spin_until(lambda: remote.of(name).state is State.THERE)
    return dict(remote.of(name).parameters)


def answered(bench: Bench, future: "Future[str]") -> str:
    bench.spin_until(future.done)
    return future.result()


def test_a_node_of_ours_says_units_ranges_choices_and_meanings(bench, remote):
    console(bench)
    known = looked_at(bench, remote, "console")
    gain, focus, planes = known["gain"], known["colour.depth"], known["elevation_planes"]
    assert (gain.kind, gain.value, gain.unit, gain.low, gain.high) == (
        Kind.NUMBER,
        0.0,
        "dB",
        -60.0,
        60.0,
    )
    assert (gain.description, gain.is_live) == ("added to every echo", True)
    assert (known["elevation_width"].value, known["elevation_width"].unit) == (2.0, "mm")
    assert (focus.value, focus.may_be_nothing, focus.unit, focus.high) == (None, True, "mm", 400.0)
    assert (planes.kind, planes.value, planes.high) == (Kind.WHOLE, 1, 15)
    assert known["grey_map"].choices == ("linear", "soft", "contrast")
    assert known["contact"].value is False
    assert known["time_gain"].value == (0.0,)
    assert (known["colour.nyquist_velocity"].value, known["colour.nyquist_velocity"].unit) == (
        30.0,
        "cm/s",
    )
    assert known["colour.steering"].unit == "deg"


def test_a_node_says_what_each_method_is_good_for(bench, remote):
    node = bench.add(Node("tissue", context=bench.context))
    LiveSettings(node, {"own": Group(TissueDeformerSettings())})
    known = looked_at(bench, remote, "tissue")
    assert known["solver"].choices == SOLVERS.names
    assert known["solver"].meanings == SOLVERS.in_short
    assert known["compare_with"].meanings == SOLVERS.in_short


def test_a_value_is_set_in_the_unit_that_is_shown(bench, remote):
    node = console(bench)
    looked_at(bench, remote, "console")
    assert answered(bench, remote.set("console", "elevation_width", 7)) == ""
    assert node.get_parameter("elevation_width").value == 0.007
    assert answered(bench, remote.set("console", "time_gain", [0, 3, 6])) == ""
    assert list(node.get_parameter("time_gain").value) == [0.0, 3.0, 6.0]
    assert answered(bench, remote.set("console", "colour.depth", 20)) == ""
    assert node.get_parameter("colour.depth").value == 0.02
    assert answered(bench, remote.set("console", "colour.depth", None)) == ""
    assert node.get_parameter("colour.depth").value == 0.0
    assert remote.of("console").parameters["elevation_width"].value == 7.0


def test_a_refused_value_says_why_and_stays_what_it_was(bench, remote):
    console(bench)
    looked_at(bench, remote, "console")
    reason = answered(bench, remote.set("console", "gain", 99))
    assert reason == "99 dB is outside -60 to 60 dB"
    reason = answered(bench, remote.set("console", "grey_map", "purple"))
    assert "'purple' is not one of linear, soft, contrast" in reason
    assert "is not a number" in answered(bench, remote.set("console", "gain", "much"))
    assert "no parameter gian" in answered(bench, remote.set("console", "gian", 1))
    assert remote.of("console").parameters["gain"].value == 0.0


def test_a_change_made_elsewhere_reaches_the_page(bench, remote):
    node = console(bench)
    looked_at(bench, remote, "console")
    before = remote.of("console")
    bench.spin_until(lambda: bench.peer.count_subscribers("/parameter_events") > 0)
    bench.spin_for(5)
    node.set_parameters([RosParameter("gain", value=6.0)])
    bench.spin_until(lambda: remote.of("console").parameters["gain"].value == 6.0)
    assert before.parameters["gain"].value == 0.0  # what was told is not changed
    node.declare_parameter("added_later", 3)
    bench.spin_until(lambda: "added_later" in remote.of("console").parameters)
    node.set_parameters([RosParameter("added_later", RosParameter.Type.NOT_SET, None)])


def test_a_node_that_goes_is_gone_and_one_that_restarts_is_read_anew(bench, remote):
    node = console(bench)
    known = looked_at(bench, remote, "console")
    assert "colour.depth" in known
    bench.executor.remove_node(node)
    bench._nodes.remove(node)
    node.destroy_node()
    bench.spin_until(lambda: remote.of("console").state is State.ABSENT)
    assert not remote.of("console").parameters
    again = bench.add(Node("console", context=bench.context))
    again.declare_parameter("other", 2.5)
    bench.spin_until(lambda: "other" in remote.of("console").parameters)
    assert set(remote.of("console").parameters) == {"other"}


def test_a_restart_between_two_looks_is_noticed(bench, remote):
    node = console(bench)
    looked_at(bench, remote, "console")
    bench.executor.remove_node(node)
    bench._nodes.remove(node)
    node.destroy_node()
    again = bench.add(Node("console", context=bench.context))
    again.declare_parameter("gain", 12.0)
    bench.spin_until(lambda: set(remote.of("console").parameters) == {"gain"})
    assert remote.of("console").parameters["gain"].value == 12.0


def test_a_foreign_node_s_plain_descriptors_will_do(bench, remote):
    node = bench.add(Node("motor", context=bench.context))
    node.declare_parameter("speed", 3.5)
    node.declare_parameter("name", "left")
    within = FloatingPointRange(from_value=0.0, to_value=2.0)
    node.declare_parameter(
        "reach",
        0.5,
        ParameterDescriptor(
            description="of the arm (m)",
            additional_constraints="one of many; in m",
            floating_point_range=[within],
        ),
    )
    node.declare_parameter(
        "turns", 1.0, ParameterDescriptor(description="a minute (rpm)", read_only=True)
    )
    node.declare_parameter("unset", None, ParameterDescriptor(dynamic_typing=True))
    known = looked_at(bench, remote, "motor")
    assert (known["speed"].value, known["speed"].unit, known["speed"].low) == (3.5, "", None)
    assert known["name"].kind is Kind.TEXT
    assert (known["reach"].value, known["reach"].unit, known["reach"].high) == (0.5, "", 2.0)
    assert (known["turns"].description, known["turns"].unit) == ("a minute (rpm)", "")
    assert not known["turns"].is_live
    assert (known["unset"].kind, known["unset"].is_live) == (Kind.OTHER, False)
    assert answered(bench, remote.set("motor", "speed", 4)) == ""
    assert node.get_parameter("speed").value == 4.0
    node.add_on_set_parameters_callback(lambda _: SetParametersResult(successful=False))
    assert answered(bench, remote.set("motor", "speed", 5)) == "motor refuses it"


def test_a_parameter_without_a_value_does_not_hide_the_others(bench, remote):
    node = bench.add(Node("motor", context=bench.context))
    node.declare_parameter("speed", 3.5)
    node.declare_parameter("torque", RosParameter.Type.DOUBLE)  # a type, and no value yet
    assert set(looked_at(bench, remote, "motor")) == {"speed"}
    bench.spin_until(lambda: bench.peer.count_subscribers("/parameter_events") > 0)
    bench.spin_for(5)
    node.set_parameters([RosParameter("torque", value=1.5)])
    bench.spin_until(lambda: "torque" in remote.of("motor").parameters)
    assert remote.of("motor").parameters["torque"].value == 1.5


def test_a_node_without_parameter_services_is_silent(bench, remote, monkeypatch):
    monkeypatch.setattr("us_sim.viewer.remote_parameters._SERVICES_S", 0.0)
    bench.add(Node("mute", context=bench.context, start_parameter_services=False))
    remote.watch("mute")
    bench.spin_until(lambda: remote.of("mute").state is State.SILENT)
    assert "no parameter" in answered(bench, remote.set("mute", "gain", 1))


def test_a_node_that_does_not_answer_is_told_so(bench, remote, monkeypatch):
    node = console(bench)
    looked_at(bench, remote, "console")
    monkeypatch.setattr("us_sim.viewer.remote_parameters.ANSWER_S", 0.0)
    bench.executor.remove_node(node)  # it hangs
    reason = answered(bench, remote.set("console", "gain", 3))
    assert reason == "console did not answer within 0 s"


def test_nothing_is_asked_while_nobody_looks(bench, remote):
    console(bench)
    looked_at(bench, remote, "console")
    remote.watch("console")
    remote.unwatch("console")
    bench.spin_for(3)
    assert bench.peer.count_subscribers("/parameter_events") > 0
    remote.unwatch("console")
    bench.spin_until(lambda: bench.peer.count_subscribers("/parameter_events") == 0)
    assert "gain" in looked_at(bench, remote, "console")  # read anew when somebody does again


def test_a_node_with_a_door_is_set_through_that_alone(bench):
    asking = bench.add(GuardedNode("asking", context=bench.context))
    asked: list[dict[str, Any]] = []
    refused: Future[str] = Future()
    refused.set_result("not from here")

    def door(**values: Any) -> "Future[str]":
        asked.append(values)
        return refused

    remote = RemoteParameters(asking, Posted(asking), {"console": door})
    node = console(bench)
    looked_at(bench, remote, "console")
    assert answered(bench, remote.set("console", "gain", 3.0)) == "not from here"
    assert asked == [{"gain": 3.0}]
    assert node.get_parameter("gain").value == 0.0
