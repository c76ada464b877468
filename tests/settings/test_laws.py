"""Laws of all settings: written and read they are the same, in whatever unit, and as a copy."""

import dataclasses
import inspect
import math
from collections.abc import Iterator
from functools import partial
from types import UnionType
from typing import Any, Union, get_args, get_origin

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

import us_sim.nodes.settings
import us_sim.volume.cases.settings  # noqa: F401 - their settings are some of all
from us_sim.errors import UsSimError
from us_sim.geometry.collider import Convex
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings import quantity as quantities
from us_sim.settings import registry
from us_sim.settings.choice import Choice
from us_sim.settings.quantity import Quantity
from us_sim.settings.reading import SettingsReader
from us_sim.settings.setting import SettingRule, Settings, kinds_of, rules_of
from us_sim.tissue.mesh.tetrahedral_mesh import MeshSettings

for choice in vars(registry).values():
    if isinstance(choice, Choice) and choice is not registry.PHANTOMS:
        for option in choice:
            choice.load_settings(option)


def kinds_below(kind: type[Settings]) -> Iterator[type[Settings]]:
    """All that are made of one, each once."""
    for below in kind.__subclasses__():
        yield below
        yield from kinds_below(below)


def strategy(kind: Any, rule: SettingRule) -> st.SearchStrategy[Any] | None:
    """Values that will do for a setting; None for what is not a number, text, truth or list."""
    if get_origin(kind) in (Union, UnionType):
        made = [strategy(k, rule) if k is not type(None) else st.none() for k in get_args(kind)]
        return st.one_of([each for each in made if each is not None])
    if kind is bool:
        return st.booleans()
    if kind is str:
        names = rule.choice.names if rule.choice else rule.choices
        return st.sampled_from(names) if names else st.sampled_from(["a", "a b", "µm", "12 kPa"])
    if get_origin(kind) is tuple:
        items = get_args(kind)
        each = strategy(items[0], rule)
        if each is None:
            return None
        if items[-1] is Ellipsis:
            return st.lists(each, max_size=4).map(tuple)
        return st.tuples(*[each] * len(items))
    if kind not in (int, float):
        return None
    quantity = rule.quantity or Quantity("number", 0, 100)
    if kind is int:
        return st.integers(round(quantity.minimum), round(quantity.maximum))
    return st.floats(quantity.minimum, quantity.maximum)


def values_of(kind: type[Settings]) -> st.SearchStrategy[dict[str, Any]]:
    """Values of settings by name, of some of them those by default."""
    required, optional = {}, {}
    for field in dataclasses.fields(kind):
        if field.name in rules_of(kind):
            made = strategy(kinds_of(kind)[field.name], rules_of(kind)[field.name])
            if made is not None:
                is_required = field.default is dataclasses.MISSING
                (required if is_required else optional)[field.name] = made
    return st.fixed_dictionaries(required, optional=optional)


def is_made_of_plain_values(kind: type[Settings]) -> bool:
    """Whether what must be given can be generated."""
    fields = [f for f in dataclasses.fields(kind) if f.name in rules_of(kind)]
    needed = [f.name for f in fields if f.default is f.default_factory is dataclasses.MISSING]
    return all(strategy(kinds_of(kind)[n], rules_of(kind)[n]) is not None for n in needed)


KINDS = sorted(
    {
        kind
        for kind in kinds_below(Settings)
        if kind.__module__.startswith("us_sim.")
        and not inspect.isabstract(kind)
        and rules_of(kind)
        and is_made_of_plain_values(kind)
        and kind not in (Convex, MeshSettings, ProbeSettings)  # few random values go together
        and kind.__name__ != "_Body"  # a file of lists of settings, see test_rigid_body
    },
    key=lambda kind: kind.__name__,
)


def written(made: Settings) -> dict[str, Any]:
    """A file's content for settings made of plain values."""
    values = {name: getattr(made, name) for name in rules_of(type(made))}
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
        if isinstance(value, bool | int | float | str | tuple | None) and value != ""
    }


def applies(made: Settings, rule: SettingRule) -> bool:
    """Whether a setting means something beside the others."""
    assert rule.applies
    other, values = rule.applies
    chosen = getattr(made, other)
    return getattr(chosen, "name", chosen) in values


def test_the_laws_are_tried_on_nearly_all_settings():
    assert len(KINDS) >= 35


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(data=st.data())
def test_what_is_written_is_read_back_and_a_copy_is_the_same(kind, data):
    try:
        made = kind(**data.draw(values_of(kind)))
    except UsSimError:
        assume(False)  # values that do not go together
    idle = {n for n, rule in rules_of(kind).items() if rule.applies and not applies(made, rule)}
    document = {n: value for n, value in written(made).items() if n not in idle}
    assert SettingsReader("my.yaml").read(kind, document) == made
    assert dataclasses.replace(made) == made
    assert dataclasses.replace(made, **{n: getattr(made, n) for n in rules_of(kind)}) == made


def wrong_values(kind: Any, rule: SettingRule) -> list[Any]:
    """Values that a setting must refuse; none for what is not a number, text, truth or list."""
    if get_origin(kind) in (Union, UnionType):
        wrong = [each for k in get_args(kind) for each in wrong_values(k, rule)]
        is_plain = not any(dataclasses.is_dataclass(k) for k in get_args(kind))
        return wrong if is_plain else [each for each in wrong if isinstance(each, str)]
    if get_origin(kind) is tuple:
        items = get_args(kind)
        beside = [0] * (len(items) - 1) if items[-1] is not Ellipsis else []
        return [True, *([each, *beside] for each in wrong_values(items[0], rule))]
    if kind is bool:
        return ["yes", 1]
    if kind is str and (rule.choices or rule.choice):
        return ["none of these", 1]
    if kind not in (int, float):
        return []
    quantity = rule.quantity or Quantity("number")
    beyond = math.nextafter(quantity.minimum, -math.inf), math.nextafter(quantity.maximum, math.inf)
    between = [round(quantity.minimum) + 0.5] if kind is int else []
    return [math.nan, math.inf, True, "many", "3 apples", *filter(math.isfinite, beyond), *between]


def go_together(kind: type[Settings], values: dict[str, Any]) -> bool:
    """Whether settings can be made of the values."""
    try:
        kind(**values)
    except UsSimError:
        return False
    return True


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=1, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_what_will_not_do_is_refused_by_its_name(kind, data):
    right = data.draw(values_of(kind).filter(partial(go_together, kind)))
    for name, rule in rules_of(kind).items():
        for wrong in wrong_values(kinds_of(kind)[name], rule):
            with pytest.raises(kind.error) as refused:
                kind(**{**right, name: wrong})
            assert refused.value.key.partition("[")[0] == name


@pytest.mark.parametrize("dimension", quantities._UNITS)
@given(number=st.floats(-1e9, 1e9))
def test_a_number_is_the_same_in_si_and_in_each_unit(dimension, number):
    quantity = Quantity(dimension)
    assert quantity.parse(number) == quantity.parse(str(number)) == number
    assert quantity.parse(f"{number!r} {quantity.unit}") == number
    for unit, factor in quantities._UNITS[dimension].items():
        assert quantity.parse(f"{number / factor!r}{unit}") == pytest.approx(number, rel=1e-12)


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9), st.floats(-2e9, 2e9))
def test_exactly_the_numbers_of_a_range_are_taken(a, b, number):
    low, high = min(a, b), max(a, b)
    quantity = Quantity("length", low, high)
    if low <= number <= high:
        assert quantity.parse(number) == number
    else:
        with pytest.raises(ValueError, match="outside"):
            quantity.parse(number)
