"""Settings as tables in Markdown, made from the settings' own rules.

>>> from us_sim.settings.tables import sections_of, table
>>> from us_sim.tissue.elasticity.material import Material
>>> print(table(Material))
| key | value | default | what it is |
| --- | --- | --- | --- |
| `young_modulus` | 0.001 Pa to 10000 GPa | needed | Young's modulus |
| `poisson_ratio` | -0.99 to 0.49999 | 0.45 | Poisson's ratio |
| `density` | 0.001 to 1000000 kg/m3 | 1000 kg/m3 | mass per volume |
| `lumen_pressure` | 1 Pa to 100 kPa | none | of a vessel's blood, which leaves if pressed by more |
| `stiffening` | 0 to 1000 | 0 | shear modulus grows by stiffening (I1 - 3)^2 / 4 of itself |
>>> from us_sim.scene.scene import TissueSettings
>>> [section.title for section in sections_of(TissueSettings, "tissue")][:3]
['tissue', 'tissue.mesh', 'tissue.mesh.pose']
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from types import UnionType
from typing import Any, Union, get_args, get_origin

from us_sim.settings.choice import Choice, Chosen
from us_sim.settings.quantity import amount, span
from us_sim.settings.setting import Rule, Settings, kinds_of, rules_of

NEEDED = "needed"
"""Where a setting has no default."""
OUTERMOST = "Outermost keys"
"""Title of the section of settings that no key leads to."""
ANY_NAME = "NAME"
"""Stands in a path of keys for a key that the person who writes the file chooses."""


@dataclass(frozen=True)
class Section:
    """A part of a reference page."""

    path: str  # of keys that lead to its settings: tissue.mesh
    title: str
    text: str  # Markdown below the heading


def sections_of(
    settings: type[Settings], path: str, shared: Mapping[type[Settings], str] | None = None
) -> Iterator[Section]:
    """A section for these settings, then one for all that stand inside of them.

    Args:
        settings: the outermost.
        path: keys that lead to them.
        shared: settings that stand in many places, with the title of the section that they have
            elsewhere.
    """
    shared = shared or {}
    text = [first_sentence(settings.__doc__), table(settings, path, shared)]
    yield Section(path, path or OUTERMOST, _joined(text))
    kinds = kinds_of(settings)
    for name, rule in rules_of(settings).items():
        options = _options_of(kinds[name], name, rule, path)
        inner = _settings_in(kinds[name])
        if options is not None:
            yield from _option_sections(options, path, shared)
        elif inner is not None and inner not in shared:
            yield from sections_of(inner, _at(path, name, kinds[name]), shared)


def table(
    settings: type[Settings], path: str = "", shared: Mapping[type[Settings], str] | None = None
) -> str:
    """Keys, values, defaults and meanings of settings; empty where there are none."""
    kinds = kinds_of(settings)
    rows = []
    for name, rule in rules_of(settings).items():
        options = _options_of(kinds[name], name, rule, path)
        inner = _settings_in(kinds[name])
        key, value = name, values(kinds[name], rule)
        if options is not None:
            key = name if rule.place == "within" else options.choice.key
            value = f"[{options.choice.what}](#{anchor(options.at)})"
        elif inner is not None:
            title = (shared or {}).get(inner) or _at(path, name, kinds[name])
            value = value.replace("keys", f"[keys](#{anchor(title)})")
        rows.append((f"`{key}`", value, default_text(settings, name), _meaning(rule)))
    return _markdown(("key", "value", "default", "what it is"), rows) if rows else ""


def values(kind: Any, rule: Rule) -> str:
    """The values of a setting of a type and rule, in words."""
    if get_origin(kind) in (Union, UnionType):
        options = [option for option in get_args(kind) if option is not type(None)]
        return ", or ".join(values(option, rule) for option in options)
    if kind is bool:
        return "true or false"
    if kind is str:
        names = rule.choice.names if rule.choice else rule.choices
        return _names(names) if names else ("file" if rule.file else "text")
    if kind in (int, float):
        numbers = span(rule.quantity) if rule.quantity else "number"
        return f"whole number {numbers}" if kind is int else numbers
    if get_origin(kind) is tuple:
        return _list(get_args(kind), rule)
    if get_origin(kind) in (dict, Mapping):
        return f"by name: {values(get_args(kind)[1], rule)}"
    return "keys"


def default_text(settings: type[Settings], name: str) -> str:
    """The default of a setting, as a person reads it."""
    field = settings.__dataclass_fields__[name]
    if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
        return NEEDED
    default = field.default
    if default is dataclasses.MISSING:
        assert field.default_factory is not dataclasses.MISSING
        default = field.default_factory()
    return _default(default, rules_of(settings)[name])


def first_sentence(docstring: str | None) -> str:
    """The first line of a docstring, as Markdown."""
    text = (docstring or "").strip().partition("\n")[0]
    return re.sub(r"``(.+?)``", r"`\1`", text)


def anchor(title: str) -> str:
    """The name of a heading in GitHub's links."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def _option_sections(
    options: _Options, path: str, shared: Mapping[type[Settings], str]
) -> Iterator[Section]:
    """The options of a choice, then the settings of each that has some."""
    choice = options.choice
    rows = []
    for name in choice.importable:
        has = bool(rules_of(choice.settings(name)))
        keys = f"[keys](#{anchor(options.title(name))})" if has else "none"
        rows.append((f"`{name}`", first_sentence(choice.option(name).docstring()), keys))
    head = (choice.what if options.by_name else f"`{choice.key}`", "what it is", "its own")
    yield Section(options.at, options.at, _markdown(head, rows))
    for name in choice.importable:
        own = choice.settings(name)
        if rules_of(own):
            text = _joined([first_sentence(own.__doc__), table(own, path, shared)])
            yield Section(options.path(name), options.title(name), text)


@dataclass(frozen=True)
class _Options:
    choice: Choice
    place: str
    by_name: bool  # the names of the options are keys, of a mapping under this setting
    below: str  # keys that lead to the settings that this one is of
    name: str  # of this one

    @property
    def at(self) -> str:
        """Keys that lead to the chosen option."""
        key = self.name if self.place == "within" else self.choice.key
        return f"{self.below}.{key}" if self.below else key

    def path(self, option: str) -> str:
        """Keys that lead to an option's own settings, or a name for the place."""
        return f"{self.below}.{option}" if self.place == "named" else f"{self.at}.{option}"

    def title(self, option: str) -> str:
        """Of the section of an option's own settings."""
        if self.by_name or self.place == "named":
            return self.path(option)
        where = self.at if self.place == "within" else self.below
        return f"{where} with {self.choice.key}: {option}"


def _options_of(kind: Any, name: str, rule: Rule, path: str) -> _Options | None:
    """The options of a setting, if they have settings of their own."""
    by_name = get_origin(kind) in (dict, Mapping)
    if rule.choice is None or not (by_name or Chosen in (kind, *get_args(kind))):
        return None
    return _Options(rule.choice, rule.place, by_name, path, name)


def _list(kinds: tuple[Any, ...], rule: Rule) -> str:
    each = values(kinds[0], rule)
    if kinds[-1] is Ellipsis:
        return f"list of {each}"
    return f"list of {len(kinds)}, each {each}"


def _default(value: Any, rule: Rule) -> str:
    if value is None or value == {} or value == ():
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        text = amount(value, rule.quantity.dimension if rule.quantity else "number")
        # Without exponents, of which `ros2 param load` takes some for texts.
        return re.sub(r"^-?[\d.]+e-\d+", lambda found: f"{Decimal(found[0]):f}", text)
    if isinstance(value, str):
        return f"`{value}`" if value else "none"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_default(item, rule) for item in value)}]"
    if isinstance(value, Chosen):
        return f"`{value.name}`"
    return "its own defaults"


def _meaning(rule: Rule) -> str:
    if rule.applies is None:
        return rule.description
    other, options = rule.applies
    only = f"only with `{other}` {_names(options)}"
    return f"{rule.description}; {only}" if rule.description else only


def _settings_in(kind: Any) -> type[Settings] | None:
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    for option in options:
        by_name = get_origin(option) in (dict, Mapping)
        inner = get_args(option)[1] if by_name else option
        if isinstance(inner, type) and issubclass(inner, Settings):
            return inner
    return None


def _at(path: str, name: str, kind: Any) -> str:
    """Keys that lead inside a setting."""
    at = f"{path}.{name}" if path else name
    return f"{at}.{ANY_NAME}" if get_origin(kind) in (dict, Mapping) else at


def _names(names: Iterable[str]) -> str:
    *most, last = (f"`{name}`" for name in names)
    return f"{', '.join(most)} or {last}" if most else last


def _markdown(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '∣') for cell in line)} |" for line in lines)


def _joined(parts: Iterable[str]) -> str:
    return "\n\n".join(part for part in parts if part)
