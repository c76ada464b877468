"""Parameters of a node: types, ranges, callbacks, descriptors, and the events that tell of them."""

import array

import pytest
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterEvent,
    ParameterType,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterAlreadyDeclaredException,
    ParameterImmutableException,
    ParameterNotDeclaredException,
    ParameterUninitializedException,
)
from rclpy.parameter import Parameter

VALUES = [
    (True, Parameter.Type.BOOL),
    (3, Parameter.Type.INTEGER),
    (0.5, Parameter.Type.DOUBLE),
    ("msds", Parameter.Type.STRING),
    ([b"\x01", b"\x02"], Parameter.Type.BYTE_ARRAY),
    ([True, False], Parameter.Type.BOOL_ARRAY),
    ([1, 2], Parameter.Type.INTEGER_ARRAY),
    ([1.0, 2.0], Parameter.Type.DOUBLE_ARRAY),
    (["a", "b"], Parameter.Type.STRING_ARRAY),
    (None, Parameter.Type.NOT_SET),
]


@pytest.mark.parametrize(("value", "type_"), VALUES)
def test_a_parameter_has_the_type_of_its_value_and_survives_its_message(value, type_) -> None:
    parameter = Parameter("p", value=value)
    assert parameter.type_ is type_
    assert type_.check(value)
    message = parameter.to_parameter_msg()
    assert message.name == "p"
    assert message.value.type == type_.value
    back = Parameter.from_parameter_msg(message)
    assert (back.type_, list(back.value) if isinstance(value, list) else back.value) == (
        type_,
        value,
    )


def test_values_that_parameters_cannot_have_are_refused() -> None:
    with pytest.raises(TypeError, match="not one of the allowed types"):
        Parameter("p", value={"a": 1})
    with pytest.raises(TypeError, match="not a list of one of the allowed types"):
        Parameter("p", value=[1, "a"])
    with pytest.raises(ValueError, match=r"Type 'Type\.INTEGER' and value '1\.5' do not agree"):
        Parameter("p", Parameter.Type.INTEGER, 1.5)
    with pytest.raises(TypeError, match="type must be an instance"):
        Parameter("p", 2, 1)
    assert Parameter("p", value=array.array("d", [1.0])).type_ is Parameter.Type.DOUBLE_ARRAY
    assert Parameter("p", value=(1, 2)).type_ is Parameter.Type.INTEGER_ARRAY


def test_declared_parameters_have_their_default_or_what_was_given_outside(bench) -> None:
    node = bench.node(
        parameter_overrides=[Parameter("rate", value=30.0), Parameter("solver", value="fem_cg")]
    )
    assert node.declare_parameter("rate", 60.0).value == 30.0
    assert node.declare_parameter("solver", "msds", ignore_override=True).value == "msds"
    names = node.declare_parameters("tissue", [("depth", 1), ("names", ["a"])])
    assert [parameter.name for parameter in names] == ["tissue.depth", "tissue.names"]
    assert node.get_parameter("tissue.depth").value == 1
    assert node.has_parameter("rate")
    assert not node.has_parameter("speed")
    assert [p.value for p in node.get_parameters(["rate", "tissue.depth"])] == [30.0, 1]
    assert node.get_parameter_type("rate") == ParameterType.PARAMETER_DOUBLE
    assert node.get_parameter_or("speed", Parameter("speed", value=9)).value == 9
    assert node.get_parameter_or("speed").type_ is Parameter.Type.NOT_SET
    assert {k: p.value for k, p in node.get_parameters_by_prefix("tissue").items()} == {
        "depth": 1,
        "names": ["a"],
    }


def test_a_parameter_may_have_a_type_and_no_value_yet(bench) -> None:
    node = bench.node(parameter_overrides=[Parameter("given", value=2)])
    assert node.declare_parameter("given", Parameter.Type.INTEGER).value == 2
    node.declare_parameter("open", Parameter.Type.INTEGER)
    with pytest.raises(ParameterUninitializedException, match="'open' is not initialized"):
        node.get_parameter("open")
    assert node.set_parameters([Parameter("open", value=5)])[0].successful
    assert node.get_parameter("open").value == 5
    with pytest.warns(UserWarning, match="only providing its name is deprecated"):
        assert node.declare_parameter("any").value is None


def test_what_cannot_be_declared(bench) -> None:
    node = bench.node(parameter_overrides=[Parameter("rate", value="fast")])
    with pytest.raises(InvalidParameterTypeException) as caught:
        node.declare_parameter("rate", 60.0)
    assert str(caught.value) == (
        "Trying to set parameter 'rate' to 'fast' of type 'STRING', expecting type 'DOUBLE': rate"
    )
    node.declare_parameter("depth", 1)
    with pytest.raises(ParameterAlreadyDeclaredException, match=r"\['depth'\]"):
        node.declare_parameter("depth", 1)
    with pytest.raises(InvalidParameterException):
        node.declare_parameter("", 1)
    with pytest.raises(TypeError, match="not a str"):
        node.declare_parameters("", [(1, 2)])
    with pytest.raises(TypeError, match="not a ParameterDescriptor"):
        node.declare_parameters("", [("a", 2, "positive")])
    with pytest.raises(TypeError, match="between 1 and 3"):
        node.declare_parameters("", [("a", 2, ParameterDescriptor(), 4)])
    with pytest.raises(ValueError, match="statically typed of type NOT_SET"):
        node.declare_parameter("a", Parameter.Type.NOT_SET)
    with pytest.raises(ValueError, match="PARAMETER_NOT_SET"):
        node.declare_parameter("a", None, ParameterDescriptor())


def test_undeclared_parameters_are_errors_unless_the_node_allows_them(bench) -> None:
    strict = bench.node("strict")
    for access in (strict.get_parameter, strict.get_parameter_type, strict.describe_parameter):
        with pytest.raises(ParameterNotDeclaredException, match="speed"):
            access("speed")
    with pytest.raises(ParameterNotDeclaredException):
        strict.set_parameters([Parameter("speed", value=1)])
    with pytest.raises(ParameterNotDeclaredException):
        strict.undeclare_parameter("speed")
    open_ = bench.node("open", allow_undeclared_parameters=True)
    assert open_.get_parameter("speed").type_ is Parameter.Type.NOT_SET
    assert open_.set_parameters([Parameter("speed", value=1)])[0].successful
    assert open_.set_parameters([Parameter("speed", value="fast")])[0].successful
    assert open_.get_parameter("speed").value == "fast"
    assert open_.set_parameters([Parameter("speed")])[0].successful
    assert not open_.has_parameter("speed")


def test_types_and_read_only_parameters_are_kept(bench) -> None:
    node = bench.node()
    node.declare_parameter("rate", 60.0)
    node.declare_parameter("seed", 1, ParameterDescriptor(read_only=True))
    node.declare_parameter("free", 1, ParameterDescriptor(dynamic_typing=True))
    results = node.set_parameters(
        [
            Parameter("rate", value=30),
            Parameter("rate"),
            Parameter("seed", value=2),
            Parameter("free", value="text"),
        ]
    )
    assert [result.successful for result in results] == [False, False, False, True]
    assert results[0].reason == ("Wrong parameter type, expected 'Type.DOUBLE' got 'Type.INTEGER'")
    assert results[1].reason == "Static parameter cannot be undeclared"
    assert results[2].reason == "Trying to set a read-only parameter: seed."
    with pytest.raises(ParameterImmutableException):
        node.undeclare_parameter("seed")
    node.undeclare_parameter("rate")
    assert not node.has_parameter("rate")


@pytest.mark.parametrize(
    ("value", "allowed"), [(0, True), (10, True), (4, True), (5, False), (-2, False), (12, False)]
)
def test_integers_keep_to_range_and_step(bench, value: int, allowed: bool) -> None:
    node = bench.node()
    limits = IntegerRange(from_value=0, to_value=10, step=2)
    node.declare_parameter("p", 2, ParameterDescriptor(integer_range=[limits]))
    assert node.set_parameters([Parameter("p", value=value)])[0].successful is allowed


@pytest.mark.parametrize(
    ("value", "allowed"),
    [(0.5, True), (1.0, True), (0.75, True), (0.8, False), (0.4, False), (1.01, False)],
)
def test_numbers_keep_to_range_and_step(bench, value: float, allowed: bool) -> None:
    node = bench.node()
    limits = FloatingPointRange(from_value=0.5, to_value=1.0, step=0.25)
    node.declare_parameter("p", 0.5, ParameterDescriptor(floating_point_range=[limits]))
    assert node.set_parameters([Parameter("p", value=value)])[0].successful is allowed
    with pytest.raises(InvalidParameterValueException, match="out of range"):
        node.declare_parameter("q", 7.0, ParameterDescriptor(floating_point_range=[limits]))


def test_callbacks_change_refuse_and_follow(bench) -> None:
    node = bench.node()
    node.declare_parameters("", [("rate", 60.0), ("period", 1.0)])
    seen: list[str] = []

    def derive(parameters: list[Parameter]) -> list[Parameter]:
        return [*parameters, *(Parameter("period", value=1 / p.value) for p in parameters)]

    def check(parameters: list[Parameter]) -> SetParametersResult:
        too_fast = any(p.name == "rate" and p.value > 100 for p in parameters)
        return SetParametersResult(successful=not too_fast, reason="too fast" if too_fast else "")

    def follow(parameters: list[Parameter]) -> None:
        seen.extend(p.name for p in parameters)

    node.add_pre_set_parameters_callback(derive)
    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(follow)
    assert node.set_parameters([Parameter("rate", value=50.0)])[0].successful
    assert node.get_parameter("period").value == 0.02
    result = node.set_parameters([Parameter("rate", value=200.0)])[0]
    assert (result.successful, result.reason) == (False, "too fast")
    assert node.get_parameter("period").value == 0.02
    assert seen == ["rate", "period"]
    node.remove_pre_set_parameters_callback(derive)
    node.remove_on_set_parameters_callback(check)
    node.remove_post_set_parameters_callback(follow)
    assert node.set_parameters([Parameter("rate", value=200.0)])[0].successful
    assert seen == ["rate", "period"]
    node.add_pre_set_parameters_callback(lambda _: [])
    assert "cannot be empty" in node.set_parameters([Parameter("rate", value=1.0)])[0].reason


def test_setting_several_at_once_is_all_or_nothing(bench) -> None:
    node = bench.node()
    node.declare_parameters("", [("a", 1), ("b", 2)])
    both = [Parameter("a", value=5), Parameter("b", value="text")]
    assert not node.set_parameters_atomically(both).successful
    assert node.get_parameter("a").value == 1
    assert [result.successful for result in node.set_parameters(both)] == [True, False]
    assert node.get_parameter("a").value == 5
    with pytest.raises(TypeError, match="must be instance of type"):
        node.set_parameters_atomically([3])


def test_descriptors_can_be_read(bench) -> None:
    node = bench.node()
    node.declare_parameter("p", 5, ParameterDescriptor(description="how deep"))
    described = node.describe_parameter("p")
    assert (described.name, described.description) == ("p", "how deep")
    assert described.type == ParameterType.PARAMETER_INTEGER


def test_parameters_are_listed_by_prefix_and_depth(bench) -> None:
    node = bench.node(start_parameter_services=False)
    node.declare_parameters("", [("a", 1), ("t.a", 1), ("t.b.c", 1), ("t.b.d.e", 1), ("tt", 1)])

    def listed(prefixes: list[str], depth: int) -> set[str]:
        own = ("use_sim_time", "start_type_description_service")
        return {n for n in node.list_parameters(prefixes, depth).names if n not in own}

    assert listed([], 0) == {"a", "t.a", "t.b.c", "t.b.d.e", "tt"}
    assert listed([], 1) == {"a", "tt"}
    assert listed([], 2) == {"a", "tt", "t.a"}
    assert listed(["t"], 1) == {"t.a"}
    assert listed(["t"], 0) == {"t.a", "t.b.c", "t.b.d.e"}
    assert listed(["t.b", "a"], 1) == {"t.b.c", "a"}
    assert set(node.list_parameters(["t"], 0).prefixes) == {"t", "t.b", "t.b.d"}
    with pytest.raises(TypeError, match="must be a list"):
        node.list_parameters("t", 0)
    with pytest.raises(ValueError, match="greater than or equal to zero"):
        node.list_parameters([], -1)


def test_every_change_is_told_on_parameter_events(bench) -> None:
    node = bench.node("probe", namespace="left", allow_undeclared_parameters=True)
    events: list[ParameterEvent] = []
    bench.node("listener").create_subscription(
        ParameterEvent, "/parameter_events", events.append, 100
    )
    assert bench.spin_until(lambda: node.count_subscribers("/parameter_events") >= 1)

    def told() -> list[tuple[str, list[str], list[str], list[str]]]:
        return [
            (
                event.node,
                [p.name for p in event.new_parameters],
                [p.name for p in event.changed_parameters],
                [p.name for p in event.deleted_parameters],
            )
            for event in events
            if event.node == "/left/probe"
        ]

    node.declare_parameter("rate", 1.0)
    assert bench.spin_until(told)
    node.set_parameters([Parameter("rate", value=2.0)])
    node.set_parameters([Parameter("free", value=2)])
    node.set_parameters([Parameter("free")])
    assert bench.spin_until(lambda: len(told()) == 4)
    assert told() == [
        ("/left/probe", ["rate"], [], []),
        ("/left/probe", [], ["rate"], []),
        ("/left/probe", ["free"], [], []),
        ("/left/probe", [], [], ["free"]),
    ]
    assert events[-1].stamp.sec > 1_000_000_000
