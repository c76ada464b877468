"""Parameters as pages show them: units there and back, nothing, and values that are none."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.errors import SettingsError
from us_sim.settings.quantity import Quantity, dial_unit, units_of
from us_sim.viewer.parameters import Kind, Parameter, in_words

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
    assert math.isclose(back, raw, rel_tol=1e-11, abs_tol=1e-300)
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
