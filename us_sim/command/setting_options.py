"""Options of a command from settings, so that a range stands where the setting stands.

A field without a default is a positional argument, or a required option where it is keyword-only;
a field with one is an option, and a flag where it is a truth.

>>> import argparse
>>> from us_sim.tracking.calibration.settings import ClockSettings
>>> parser = argparse.ArgumentParser()
>>> add_setting_options(parser, ClockSettings)
>>> args = parser.parse_args(["a.mcap", "b.mcap", "--largest", "2 min", "--images"])
>>> read_settings(args, ClockSettings)
Traceback (most recent call last):
...
us_sim.errors.CalibrationError: --largest: '2 min' is not a time: its units are s, ms, us, µs
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from us_sim.errors import UsSimError
from us_sim.settings.setting import Settings, kinds_of, rules_of

S = TypeVar("S", bound=Settings)


def add_setting_options(
    parser: argparse.ArgumentParser, settings: type[Settings], only: Iterable[str] = ()
) -> None:
    """Add an option for each setting, or only for some."""
    wanted = set(only) or set(rules_of(settings))
    for field in dataclasses.fields(settings):
        if field.name in wanted:
            _add(parser, settings, field)


def read_settings(
    args: argparse.Namespace, settings: type[S], only: Iterable[str] = (), **values: Any
) -> S:
    """The settings that the options say.

    Args:
        args: of a parser that `add_setting_options` has filled.
        settings: their class.
        only: as they were added.
        values: of fields that are no options.

    Raises:
        UsSimError: of the settings' own kind: an option's value will not do.
    """
    for name in set(only) or set(rules_of(settings)):
        if name in args:
            values[name] = getattr(args, name)
    try:
        return settings(**values)
    except UsSimError as error:
        if error.key:
            option = error.key.split("[")[0].replace("_", "-")
            raise type(error)(f"--{option}: {error.problem}") from error
        raise


def _add(
    parser: argparse.ArgumentParser, settings: type[Settings], field: dataclasses.Field[Any]
) -> None:
    rule, kind = rules_of(settings)[field.name], kinds_of(settings)[field.name]
    option = f"--{field.name.replace('_', '-')}"
    if kind is bool:
        parser.add_argument(option, action="store_true", help=rule.description)
        return
    if get_origin(kind) is not tuple:  # a type, or one that may be None
        kind = next((part for part in get_args(kind) if part is not type(None)), kind)
    unit = rule.quantity.unit if rule.quantity else ""
    names = ", ".join(rule.choice.names if rule.choice else rule.choices)
    told: dict[str, Any] = {"type": Path} if kind is Path else {}
    told["help"] = rule.description + (names and f": {names}")
    if get_origin(kind) is tuple:
        told["nargs"] = "+" if Ellipsis in get_args(kind) else len(get_args(kind))
    required = field.default is dataclasses.MISSING
    if required and not field.kw_only:
        parser.add_argument(field.name, **told)
        return
    if not required:
        told["default"] = argparse.SUPPRESS
        told["help"] += f"; default: {field.default} {unit}".rstrip() if field.default else ""
    named = "FILE" if kind is Path else "N" if rule.quantity else "NAME"
    parser.add_argument(option, metavar=unit.upper() or named, required=required, **told)
