"""Which parameters stand where in the panels.

What a slider covers: the value always, the range where it can, by factors where that is wide.
"""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from us_sim.viewer.panels.controls import choose_slider_span, count_sliders, resample_gains
from us_sim.viewer.panels.nodes import arrange_tissue
from us_sim.viewer.panels.sections import arrange_parameters
from us_sim.viewer.parameters import Parameter, ParameterKind


def known(*names: str, **fields: object) -> dict[str, Parameter]:
    return {name: Parameter("n", name, ParameterKind.NUMBER, 1.0, **fields) for name in names}


def test_the_common_come_first_and_the_rest_by_groups():
    parameters = known("noise", "gain", "colour.gain", "depth", "colour.steering", "a.b.c")
    parameters |= known("scene", "frame", "qos.x", is_live=False)
    sections = arrange_parameters(parameters, ("depth", "gain", "time_gain"))
    assert [(s.title, s.names) for s in sections] == [
        ("", ("depth", "gain")),
        ("More", ("noise",)),
        ("Colour", ("colour.gain", "colour.steering")),
        ("A · b", ("a.b.c",)),
        ("Given at the start", ("frame", "qos.x")),
    ]
    assert sections[-1].labels["qos.x"] == "qos · x"


def test_only_the_settings_of_the_methods_in_use_are_shown():
    methods = ("fem", "msds", "fem_cg")
    parameters = {
        "solver": Parameter("n", "solver", ParameterKind.TEXT, "fem_cg", choices=methods),
        "compare_with": Parameter(
            "n", "compare_with", ParameterKind.TEXT, "", choices=methods, may_be_nothing=True
        ),
    }
    parameters |= known("msds.steps", "fem_cg.iterations", "marker_rate")
    parameters |= known(
        *(f"materials.{s}.{p}" for s in ("fat", "bone") for p in ("young_modulus", "density"))
    )

    def shown() -> list[tuple[str, tuple[str, ...]]]:
        return [(s.title, s.names) for s in arrange_tissue(parameters) if s.is_shown]

    assert shown() == [
        ("", ("solver", "compare_with")),
        ("Settings of fem_cg", ("fem_cg.iterations",)),
        ("Young's modulus", ("materials.fat.young_modulus", "materials.bone.young_modulus")),
        ("More", ("marker_rate",)),
        ("Materials · fat", ("materials.fat.density",)),
        ("Materials · bone", ("materials.bone.density",)),
    ]
    parameters["compare_with"] = parameters["compare_with"].with_raw("msds")
    assert ("Settings of msds", ("msds.steps",)) in shown()
    every = {name for section in arrange_tissue(parameters) for name in section.names}
    assert every == set(parameters)
    empty = Parameter(
        "n", "materials.fat.lumen_pressure", ParameterKind.NUMBER, 0.0, may_be_nothing=True
    )
    parameters[empty.name] = empty
    name = "materials.bone.lumen_pressure"
    parameters |= known(name, may_be_nothing=True)
    (pressure,) = (s for s in arrange_tissue(parameters) if s.title == "Pressure of blood")
    assert pressure.labels == {name: "Bone pressure"}


def test_time_gain_is_shown_on_as_many_sliders_as_a_console_has():
    assert [count_sliders([0.0] * n) for n in (1, 2, 3, 12, 13)] == [8, 8, 3, 12, 8]
    assert resample_gains((3.0,), 4) == [3.0] * 4
    assert resample_gains((), 2) == [0.0, 0.0]
    assert resample_gains((0.0, 10.0, 0.0), 5) == [0.0, 5.0, 10.0, 5.0, 0.0]


@pytest.mark.parametrize(
    ("low", "high", "value", "is_whole", "covered"),
    [
        (-60.0, 60.0, 6.0, False, (-60.0, 60.0, 0.2, False)),  # gain, dB
        (1e-6, 1e10, 12.0, False, (0.12, 1200.0, 0.0, True)),  # Young's modulus, kPa
        (0.0, 400.0, None, False, (0.0, 400.0, 1.0, False)),  # focus, mm, not given
        (1, 10_000, 20, True, (1, 100, 1.0, False)),  # iterations
    ],
)
def test_sliders_cover_what_a_person_would_turn_through(low, high, value, is_whole, covered):
    span = choose_slider_span(low, high, value, is_whole)
    assert (span.low, span.high, span.step, span.is_logarithmic) == pytest.approx(covered)


@pytest.mark.parametrize(
    ("value", "high"), [(None, 30.0), (8.0, 30.0), (30.0, 100.0), (64.0, 200.0), (500.0, 750.0)]
)
def test_blood_pressure_is_turned_in_whole_mmhg(value, high):
    span = choose_slider_span(0.0750063, 750.0, value, unit="mmHg")
    assert not span.is_logarithmic
    assert (span.low, span.high) == (0.0750063, high)
    assert span.step == (1.0 if high < 600.0 else 2.0)


def test_there_is_no_slider_without_a_range():
    assert choose_slider_span(0.0, float("inf"), 1.0) is None
    assert choose_slider_span(3.0, 3.0, 3.0) is None
    assert choose_slider_span(0.0, 5e-324, 5e-324) is None


@settings(deadline=None)  # the first call may come while the machine is busy
@example(-5e-324, 1.0, 0.0, False)
@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e7), st.floats(0.0, 1.0), st.booleans())
def test_the_value_is_on_the_slider_and_the_slider_within_the_range(low, width, place, is_whole):
    high = low + width
    value = min(max(low + place * width, low), high)
    span = choose_slider_span(low, high, round(value) if is_whole else value, is_whole)
    assert low <= span.low < span.high <= high
    assert is_whole or span.has_value(value)
    assert span.has_value(None)
    assert span.is_logarithmic or span.step > 0.0
