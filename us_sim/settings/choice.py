"""Choices by name: solvers, slicers, probes and the like.

A choice knows each option's class by where it is, so that only what is chosen is imported. An
installed package adds options of its own under the choice's entry point group.

>>> from us_sim.settings.choice import Choice
>>> fractions = Choice("number", key="kind", fraction="fractions:Fraction")
>>> fractions.load("fraction")(1, 2)
Fraction(1, 2)
>>> fractions.load("fractoin")
Traceback (most recent call last):
...
us_sim.errors.SettingsError: number 'fractoin' is not one of fraction; did you mean 'fraction'?
"""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import importlib.util
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from us_sim.errors import SettingsError, UsSimError
from us_sim.settings.setting import Settings
from us_sim.settings.spelling import describe_unknown

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Option:
    """Place of one option's class, as ``module:name``."""

    target: str  # its class
    settings: str | None = None  # its settings; not given, its class's attribute ``Settings``
    package: str | None = None  # the installed package that adds it; None for this one

    def load(self) -> Any:
        """Import the class.

        Raises:
            SettingsError: a package that adds it cannot be imported.
        """
        return self._import(self.target)

    def read_docstring(self) -> str | None:
        """Read the docstring of the class, without importing it: that may need rclpy."""
        module, _, name = self.target.partition(":")
        spec = importlib.util.find_spec(module)
        if spec is not None and spec.origin is not None:
            for defined in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
                if isinstance(defined, ast.ClassDef) and defined.name == name:
                    return ast.get_docstring(defined)
        return getattr(self.load(), "__doc__", None)

    def load_settings(self) -> type[Settings]:
        """Import the settings class: the named one, or else the class's attribute ``Settings``."""
        if self.settings is not None:
            found: type[Settings] = self._import(self.settings)
            return found
        target = self.load()
        if isinstance(target, type) and issubclass(target, Settings):
            return target
        own = getattr(target, "Settings", Settings)
        if not (isinstance(own, type) and issubclass(own, Settings)):
            raise SettingsError(f"{self.target}: its `Settings` is no us_sim settings class")
        return own

    def _import(self, target: str) -> Any:
        module, _, name = target.partition(":")
        if self.package is None:
            return getattr(importlib.import_module(module), name)
        try:
            return getattr(importlib.import_module(module), name)
        except Exception as error:  # whatever another's package raises while it is imported
            raise SettingsError(
                f"{target}, which the package {self.package} adds, cannot be imported: {error}"
            ) from error


class Choice:
    """The options of one kind.

    Args:
        what: noun for the options, for a person: ``tissue solver``.
        key: key under which a file names its option.
        group: entry point group of other packages' options; they may not replace ours.
        error: class of the error for an unknown name.
        needs: whether options have required settings.
        described: whether an option's class may describe itself in ``in_short``.
        options: each option, or its class as ``module:name``, by name.
    """

    def __init__(
        self,
        what: str,
        *,
        key: str,
        group: str | None = None,
        error: type[UsSimError] = SettingsError,
        needs: bool = False,
        described: bool = False,
        **options: str | Option,
    ) -> None:
        self.what, self.key, self.group, self.needs = what, key, group, needs
        self._described = described
        self._error = error
        self._broken: set[Option] = set()
        self._own = {
            name: option if isinstance(option, Option) else Option(option)
            for name, option in options.items()
        }

    @cached_property
    def options(self) -> dict[str, Option]:
        """All options by name: this package's first, then those that others add."""
        if self.group is None:
            return self._own
        added = {
            point.name: Option(point.value, package=point.dist.name if point.dist else point.value)
            for point in importlib.metadata.entry_points(group=self.group)
        }
        for name in added.keys() & self._own.keys():
            package = added.pop(name).package
            _logger.warning(
                "%s %s of the package %s is not used: the name is taken", self.what, name, package
            )
        return self._own | added

    @property
    def names(self) -> tuple[str, ...]:
        """The options' names."""
        return tuple(self.options)

    @property
    def importable(self) -> tuple[str, ...]:
        """The options that can be imported; a broken one of another package is reported once."""
        for name, option in self.options.items():
            if option.package is not None and option not in self._broken:
                try:
                    option.load_settings()
                except SettingsError as error:
                    self._broken.add(option)
                    _logger.warning("%s; there is no %s %s here", error, self.what, name)
        return tuple(name for name, option in self.options.items() if option not in self._broken)

    def get_option(self, name: str) -> Option:
        """Return the option of that name.

        Raises:
            SettingsError: or the choice's own error: there is none; the sentence lists the names.
        """
        if name not in self.options:
            raise self._error(f"{self.what} {describe_unknown(name, self.names)}")
        return self.options[name]

    def load(self, name: str) -> Any:
        """Import the class of that name; an unknown name is refused as by `get_option`."""
        return self.get_option(name).load()

    def load_settings(self, name: str) -> type[Settings]:
        """Import the settings class of that name; an unknown name is refused as by `get_option`."""
        return self.get_option(name).load_settings()

    @property
    def summaries(self) -> dict[str, str]:
        """Descriptions of the options that can be imported, by name; imports all of them."""
        if not self._described:
            return {}
        said = {name: getattr(self.load(name), "in_short", "") for name in self.importable}
        return {name: text for name, text in said.items() if text}

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)


@dataclass(frozen=True)
class ChosenOption:
    """A name that was chosen, with the settings that were given for it, if any were."""

    name: str
    given: Settings | None = None

    def resolve_settings(self, choice: Choice) -> Any:
        """Return the settings that were given, or the option's defaults."""
        return self.given if self.given is not None else choice.load_settings(self.name)()
