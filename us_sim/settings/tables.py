"""Settings as tables in Markdown, made from the settings' own rules.

>>> from us_sim.settings.tables import make_sections, tabulate_settings
>>> from us_sim.tissue.elasticity.material import Material
>>> print(tabulate_settings(Material))
| key | value | default | what it is |
| --- | --- | --- | --- |
| `young_modulus` | 0.001 Pa to 10000 GPa | needed | Young's modulus |
| `poisson_ratio` | -0.99 to 0.49999 | 0.45 | Poisson's ratio |
| `density` | 0.001 to 1000000 kg/m3 | 1000 kg/m3 | mass per volume |
| `lumen_pressure` | 1 Pa to 100 kPa | none | of a vessel's blood, which leaves under more |
>>> from us_sim.scene.scene import TissueSettings
>>> [section.title for section in make_sections(TissueSettings, "tissue")][:3]
['tissue', 'tissue.mesh', 'tissue.mesh.pose']
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass
from decimal import Decimal
from types import UnionType
from typing import Any, Union, get_args, get_origin

from us_sim.settings.choice import ChosenOption
from us_sim.settings.quantity import format_quantity, format_range
from us_sim.settings.reading import join_keys
from us_sim.settings.setting import SettingRule, Settings, kinds_of, rules_of


@dataclass(frozen=True)
class Section:
    """A part of a reference page."""

    path: str  # of keys that lead to its settings: tissue.mesh
    title: str
    text: str  # Markdown below the heading


def make_sections(
    settings: type[Settings], path: str, shared: Mapping[type[Settings], str] | None = None
) -> Iterator[Section]:
    """Make a section for these settings, then one for all that stand inside of them.

    Args:
        settings: the outermost.
        path: keys that lead to them.
        shared: settings that stand in many places, with the title of the section that they have
            elsewhere.
    """
    shared = shared or {}
    yield Section(path, path or "Outermost keys", _make_text(settings, path, shared))
    for name, rule in rules_of(settings).items():
        kind = kinds_of(settings)[name]
        inner = _settings_in(kind)
        if _has_options(kind, rule):
            yield from _option_sections(kind, name, rule, path, shared)
        elif inner is not None and inner not in shared:
            yield from make_sections(inner, _join_inner_keys(path, name, kind), shared)


def tabulate_settings(
    settings: type[Settings], path: str = "", shared: Mapping[type[Settings], str] | None = None
) -> str:
    """Make a table of keys, values, defaults and meanings; nothing where there are none."""
    rows = []
    for name, rule in rules_of(settings).items():
        kind = kinds_of(settings)[name]
        inner = _settings_in(kind)
        key, value = name, describe_values(kind, rule)
        if _has_options(kind, rule):
            key = name if rule.place == "within" else rule.choice.key
            value = f"[{rule.choice.what}](#{make_anchor(join_keys(path, key))})"
        elif inner is not None:
            title = (shared or {}).get(inner) or _join_inner_keys(path, name, kind)
            value = value.replace("keys", f"[keys](#{make_anchor(title)})")
        meaning = rule.description
        if rule.applies:
            only = f"only with `{rule.applies[0]}` {_format_names(rule.applies[1])}"
            meaning = f"{meaning}; {only}" if meaning else only
        rows.append((f"`{key}`", value, describe_default(settings, name), meaning))
    return format_table(("key", "value", "default", "what it is"), rows) if rows else ""


def describe_values(kind: Any, rule: SettingRule) -> str:
    """Describe the values of a setting of a type and rule in words."""
    if get_origin(kind) in (Union, UnionType):
        options = [option for option in get_args(kind) if option is not type(None)]
        return ", or ".join(describe_values(option, rule) for option in options)
    if kind is bool:
        return "true/false"
    if kind is str:
        names = rule.choice.names if rule.choice else rule.choices
        return _format_names(names) if names else ("file" if rule.file else "text")
    if kind in (int, float):
        numbers = format_range(rule.quantity) if rule.quantity else "number"
        return f"integer {numbers}" if kind is int else numbers
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        count = "" if kinds[-1] is Ellipsis else f"{len(kinds)}, each "
        return f"list of {count}{describe_values(kinds[0], rule)}"
    if _is_mapping(kind):
        return f"by name: {describe_values(get_args(kind)[1], rule)}"
    return "keys"


def describe_default(settings: type[Settings], name: str) -> str:
    """Describe the default of a setting as a person reads it."""
    field, rule = settings.__dataclass_fields__[name], rules_of(settings)[name]
    if field.default_factory is not MISSING:
        return _format_default(field.default_factory(), rule)
    return "needed" if field.default is MISSING else _format_default(field.default, rule)


def extract_summary(docstring: str | None) -> str:
    """Return the first line of a docstring as Markdown."""
    text = (docstring or "").strip().partition("\n")[0]
    return re.sub(r"``(.+?)``", r"`\1`", text)


def make_anchor(title: str) -> str:
    """Return the name of a heading in GitHub's links."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def format_table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """Write a table in Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '∣') for cell in line)} |" for line in lines)


def _option_sections(
    kind: Any, name: str, rule: SettingRule, path: str, shared: Mapping[type[Settings], str]
) -> Iterator[Section]:
    """Make a section of the options of a choice, then one of each that has settings."""
    choice, within, named = rule.choice, rule.place == "within", rule.place == "named"
    at = join_keys(path, name if within else choice.key)
    rows, sections = [], []
    for option in choice.importable:
        own, keys = choice.load_settings(option), "none"
        if rules_of(own):
            place = join_keys(path if named else at, option)
            title = f"{at if within else path} with {choice.key}: {option}"
            title = place if named or _is_mapping(kind) else title
            sections.append(Section(place, title, _make_text(own, path, shared)))
            keys = f"[keys](#{make_anchor(title)})"
        rows.append(
            (f"`{option}`", extract_summary(choice.get_option(option).read_docstring()), keys)
        )
    head = (choice.what if _is_mapping(kind) else f"`{choice.key}`", "what it is", "its own")
    yield Section(at, at, format_table(head, rows))
    yield from sections


def _make_text(settings: type[Settings], path: str, shared: Mapping[type[Settings], str]) -> str:
    parts = (extract_summary(settings.__doc__), tabulate_settings(settings, path, shared))
    return "\n\n".join(filter(None, parts))


def _has_options(kind: Any, rule: SettingRule) -> bool:
    """Return whether a setting's values are options that have settings of their own."""
    return bool(rule.choice) and (_is_mapping(kind) or ChosenOption in (kind, *get_args(kind)))


def _is_mapping(kind: Any) -> bool:
    return get_origin(kind) in (dict, Mapping)


def _settings_in(kind: Any) -> type[Settings] | None:
    for option in get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,):
        inner = get_args(option)[1] if _is_mapping(option) else option
        if isinstance(inner, type) and issubclass(inner, Settings):
            return inner
    return None


def _join_inner_keys(path: str, name: str, kind: Any) -> str:
    """Return the keys that lead inside a setting; NAME is a person's own choice."""
    return join_keys(path, name) + ".NAME" * _is_mapping(kind)


def _format_default(value: Any, rule: SettingRule) -> str:
    if value is None or value in ({}, (), ""):
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        text = format_quantity(value, rule.quantity.dimension if rule.quantity else "number")
        # Without exponents, of which `ros2 param load` takes some for texts.
        return re.sub(r"^-?[\d.]+e-\d+", lambda found: f"{Decimal(found[0]):f}", text)
    if isinstance(value, tuple | list):
        return f"[{', '.join(_format_default(item, rule) for item in value)}]"
    if isinstance(value, str | ChosenOption):
        return f"`{getattr(value, 'name', value)}`"
    return "see keys"


def _format_names(names: Iterable[str]) -> str:
    *most, last = (f"`{name}`" for name in names)
    return f"{', '.join(most)} or {last}" if most else last
