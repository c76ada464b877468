"""A setting: a field of a frozen dataclass, with its unit, range and meaning said once.

>>> from dataclasses import dataclass
>>> from us_sim.settings.quantity import Quantity
>>> from us_sim.settings.setting import Settings, setting
>>> @dataclass(frozen=True)
... class Tank(Settings):
...     section = "tank"
...     depth: float = setting(Quantity("length", 0.01, 2.0), "of the water")
>>> Tank(depth="40 cm").depth
0.4
>>> Tank(depth=40)
Traceback (most recent call last):
...
us_sim.errors.SettingsError: tank.depth: 40 m is outside 0.01 to 2 m; did you mean '40 cm'?
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, Union, get_args, get_origin

from us_sim.errors import SettingsError, UsSimError
from us_sim.settings.quantity import Quantity
from us_sim.settings.spelling import describe_unknown, short_repr


@dataclass(frozen=True)
class SettingRule:
    """Properties of a setting beside its name, type and default."""

    quantity: Quantity | None = None  # unit and range of a number, or of each number of a list
    description: str = ""  # for a person, without the unit
    choices: tuple[str, ...] = ()  # the only allowed texts
    choice: Any = None  # or the names that a `settings.choice.Choice` has
    place: str = "within"  # where the keys of what is chosen are, see `setting`
    file: bool = False  # a text that names a file
    live: bool = False  # may change while what it sets is running
    applies: tuple[str, tuple[str, ...]] | None = None  # another setting, and its values


def setting(
    quantity: Quantity | None = None,
    description: str = "",
    *,
    choices: Sequence[str] = (),
    choice: Any = None,
    place: str = "within",
    file: bool = False,
    live: bool = False,
    applies: tuple[str, tuple[str, ...]] | None = None,
    **options: Any,
) -> Any:
    """Make a field of a `Settings` class.

    Args:
        quantity: unit and range of a number, or of each number in a list.
        description: what it is, without its unit, which `quantity` says.
        choices: the only allowed texts.
        choice: the registry that the value is a name in (type ``str``), or that it chooses from
            (type `ChosenOption`), or whose names are its keys (type ``dict``).
        place: where the keys of what is chosen stand. ``within`` the mapping under this field's
            name, with the registry's key; ``beside`` the other fields; or ``named``: under a key
            that is the chosen name, beside the other fields.
        file: the text names a file, which must be there.
        live: it may change while what it sets is running.
        applies: the name of another field, and the values of that with which this one means
            something.
        options: ``default``, ``default_factory`` and others of `dataclasses.field`.
    """
    rule = SettingRule(quantity, description, tuple(choices), choice, place, file, live, applies)
    return field(metadata={"rule": rule}, **options)


@dataclass(frozen=True)
class Settings:
    """Base of the frozen dataclasses whose fields are settings.

    Each value is converted to its type by its rule, or refused. A subclass checks settings that
    must go together in `check`.

    Raises:
        SettingsError: or what ``error`` names: a sentence with the section, the field, the value
            and what would do.
    """

    section: ClassVar[str] = ""
    """The keys that lead to these settings, for sentences: ``probe.collider``."""
    error: ClassVar[type[UsSimError]] = SettingsError
    """The class of errors."""
    live: ClassVar[bool] = False
    """True if all of these settings may change while what they set is running."""
    alternatives: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Mutually exclusive settings and their dependants."""

    def __post_init__(self) -> None:
        kinds = kinds_of(type(self))
        for name, rule in rules_of(type(self)).items():
            value = getattr(self, name)
            if value is not _default(type(self), name):
                try:
                    value = convert_value(kinds[name], value, rule)
                except RefusedValueError as refusal:
                    raise self.make_error(f"{name}{refusal.key}", refusal.problem) from refusal
                object.__setattr__(self, name, value)
        for name in rules_of(type(self)):
            problem = self.explain_inapplicable(name)
            if problem and getattr(self, name) != _default(type(self), name):
                raise self.make_error(name, problem)
        self.check()

    def explain_inapplicable(self, name: str) -> str:
        """Return the reason why a setting has no meaning beside another one; "" if it has."""
        applies = rules_of(type(self))[name].applies
        if applies is None:
            return ""
        other, values = applies
        chosen = getattr(self, other)
        chosen = getattr(chosen, "name", chosen)
        wanted = " or ".join(values)
        return "" if chosen in values else f"is for {other} {wanted} only, not {chosen}"

    def get_upper_limit(self, name: str) -> float:
        """Return the largest value of a number beside the other settings."""
        return rules_of(type(self))[name].quantity.maximum  # type: ignore[union-attr]

    def check(self) -> None:
        """Refuse values that do not go together."""

    def require_new_file(self, key: str, *endings: str, picture: bool = False) -> None:
        """Refuse a file to write that ends otherwise, exists (or its PNG), or is in no folder."""
        file: Path = getattr(self, key)
        if file.suffix.lower() not in endings:
            raise self.make_error(key, f"{file}: must be a file that ends in {endings[0]}")
        for each in (file, file.with_suffix(".png")) if picture else (file,):
            if each.exists():
                raise self.make_error(key, f"{each}: exists already; choose another name")
        if not file.absolute().parent.is_dir():
            raise self.make_error(key, f"{file}: there is no {file.absolute().parent}")

    def make_error(self, key: str, problem: str) -> UsSimError:
        """Make the error for a wrong value of one of these settings."""
        error = self.error(f"{self.section}.{key}: {problem}" if self.section else problem)
        error.key, error.problem = key, problem
        return error


class RefusedValueError(ValueError):
    """A value that a setting refuses, with the rest of the path of keys to it, and the fault."""

    def __init__(self, problem: str, key: str = "") -> None:
        super().__init__(problem)
        self.key, self.problem = key, problem


_rules: dict[type, dict[str, SettingRule]] = {}
_kinds: dict[type, dict[str, Any]] = {}


def rules_of(settings: type) -> dict[str, SettingRule]:
    """Return the rules of a dataclass's settings by name, in order; other fields are left out."""
    if settings not in _rules:
        fields = dataclasses.fields(settings)
        _rules[settings] = {f.name: f.metadata["rule"] for f in fields if "rule" in f.metadata}
    return _rules[settings]


def kinds_of(settings: type) -> dict[str, Any]:
    """Return the types of a dataclass's settings by name."""
    if settings not in _kinds:
        hints = typing.get_type_hints(settings)
        _kinds[settings] = {name: hints[name] for name in rules_of(settings)}
    return _kinds[settings]


def _default(settings: type, name: str) -> Any:
    return settings.__dataclass_fields__[name].default  # type: ignore[attr-defined]


Converter = Callable[[Any, Any, SettingRule], Any]
"""Converts a value: takes the type, the value and the rule of its setting."""


def convert_value(kind: Any, value: Any, rule: SettingRule, other: Converter | None = None) -> Any:
    """Convert a value to its type by its rule: numbers to SI units, lists to tuples.

    Args:
        kind: a type that a setting may have.
        value: as written in a file, given as a parameter, or in Python.
        rule: of the setting.
        other: converts values that are neither number, text, truth nor a list of them; without
            it they are left as they are.

    Raises:
        RefusedValueError: with the rest of the path of keys.
    """
    if get_origin(kind) in (Union, UnionType):
        if value is None:
            return None
        options = [option for option in get_args(kind) if option is not type(None)]
        kind = next((option for option in options if _fits_type(option, value)), options[0])
    if kind in (int, float):
        return _convert_number(kind, value, rule)
    if kind is bool:
        if not isinstance(value, bool):
            raise RefusedValueError(f"must be true or false, not {short_repr(value)}")
        return value
    if kind is str:
        return _convert_text(value, rule)
    if get_origin(kind) is tuple:
        return tuple(_convert_items(get_args(kind), value, rule, other))
    return value if other is None else other(kind, value, rule)


def _convert_number(kind: type, value: Any, rule: SettingRule) -> float | int:
    try:
        number = (rule.quantity or Quantity("number")).parse(value)
    except ValueError as error:
        raise RefusedValueError(str(error)) from error
    if kind is int and number != int(number):
        raise RefusedValueError(f"{short_repr(value)} is not a whole number")
    return kind(number)  # type: ignore[no-any-return]


def _convert_text(value: Any, rule: SettingRule) -> str:
    if not isinstance(value, str):
        raise RefusedValueError(f"must be a text, not {short_repr(value)}")
    choices = rule.choice.names if rule.choice else rule.choices
    if choices and value not in choices:
        raise RefusedValueError(describe_unknown(value, choices))
    return value


def _convert_items(
    kinds: tuple[Any, ...], value: Any, rule: SettingRule, other: Converter | None
) -> Iterator[Any]:
    """Yield the items of a list, each converted; check their number where the type fixes it."""
    if isinstance(value, str | dict) or not hasattr(value, "__iter__"):
        raise RefusedValueError(f"must be a list, not {short_repr(value)}")
    items = list(value)
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(items)
    if len(items) != len(kinds):
        raise RefusedValueError(f"needs {len(kinds)} values, not {len(items)}")
    for i, (kind, item) in enumerate(zip(kinds, items, strict=True)):
        try:
            yield convert_value(kind, item, rule, other)
        except RefusedValueError as refusal:
            raise RefusedValueError(refusal.problem, f"[{i}]{refusal.key}") from refusal


def _fits_type(kind: Any, value: object) -> bool:
    """Return whether a value looks like one of that type, where several are possible."""
    if isinstance(value, list | tuple):
        return get_origin(kind) is tuple
    if isinstance(value, dict):
        return dataclasses.is_dataclass(kind)
    if dataclasses.is_dataclass(kind):
        return isinstance(value, kind)  # type: ignore[arg-type]
    return kind in (str, int, float) if isinstance(value, str) else kind in (int, float)
