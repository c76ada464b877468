"""Settings from a mapping of keys, as a file holds it, every key and value checked; and back.

>>> from us_sim.settings.reading import SettingsReader, dump_settings
>>> from us_sim.skin.settings import SkinSettings
>>> reader = SettingsReader("my.yaml")
>>> skin = reader.read(SkinSettings, {"spacing": "5 mm", "size": ["12 cm", "10 cm"]})
>>> dump_settings(skin)
{'size': [0.12, 0.1], 'spacing': 0.005}
>>> reader.read(SkinSettings, {"spacign": "5 mm"}, "skin")
Traceback (most recent call last):
...
us_sim.errors.SettingsError: my.yaml: skin.spacign: unknown key; did you mean `spacing`?
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, TypeVar, get_args, get_origin

from us_sim.errors import SettingsError, UsSimError
from us_sim.settings.choice import Choice, ChosenOption
from us_sim.settings.setting import (
    RefusedValueError,
    SettingRule,
    Settings,
    convert_value,
    kinds_of,
    rules_of,
)
from us_sim.settings.spelling import describe_unknown, find_closest, short_repr

S = TypeVar("S", bound=Settings)


class SettingsReader:
    """Reads settings from one document.

    Args:
        origin: name of the document in error sentences, such as a file's path.
        find_file: called with the text of a setting that names a file and its path of keys;
            returns the text to keep, or raises ``error`` where there is no such file.
        error: class of the errors.
    """

    def __init__(
        self,
        origin: str,
        find_file: Callable[[str, str], str] | None = None,
        error: type[UsSimError] = SettingsError,
    ) -> None:
        self._origin = origin
        self._find_file = find_file
        self._error = error

    def read(self, settings: type[S], document: object, path: str = "") -> S:
        """Make an instance of ``settings`` from a mapping.

        Args:
            settings: their class.
            document: the mapping, as YAML or JSON gives it.
            path: the keys that lead to it, with dots.

        Raises:
            SettingsError: or the reader's own error: a key is unknown or missing, or a value will
                not do; one sentence with the document, the key and what would be right.
        """
        mapping = self._require_mapping(document, path)
        rules, kinds = rules_of(settings), kinds_of(settings)
        values: dict[str, Any] = {}
        here = {n for n, rule in rules.items() if rule.choice and rule.place != "within"}
        known = set(rules) - here
        for name in here:
            rule = rules[name]
            taken, values[name] = self._read_chosen_here(settings, name, rule, mapping, path, known)
            known |= taken
        for key in mapping:
            if key not in known:
                raise self._make_key_error(key, known, path)
        for name, rule in rules.items():
            at = join_keys(path, name)
            if name in mapping and name not in values:
                values[name] = self._read_value(kinds[name], mapping[name], rule, at)
            elif name not in values and _is_required(settings, name):
                raise self._make_error(at, "is missing")
        return self._make(settings, values, mapping, path)

    def _make(
        self, settings: type[S], values: dict[str, Any], given: Iterable[str], path: str
    ) -> S:
        try:
            made = settings(**values)
        except UsSimError as error:
            if not error.problem:
                raise self._error(f"{self._origin}: {error}") from error
            raise self._make_error(join_keys(path, error.key), error.problem) from error
        for name in rules_of(settings):
            problem = made.explain_inapplicable(name)
            if problem and name in given:  # also where it is the default
                raise self._make_error(join_keys(path, name), problem)
        return made

    def _read_value(self, kind: Any, value: object, rule: SettingRule, path: str) -> Any:
        listed = get_args(kind)[0] if get_origin(kind) is tuple else None
        if isinstance(listed, type) and issubclass(listed, Settings):
            if not isinstance(value, list):
                raise self._make_error(path, f"must be a list, not {short_repr(value)}")
            return tuple(self.read(listed, each, f"{path}[{i}]") for i, each in enumerate(value))
        try:
            made = convert_value(kind, value, rule, lambda k, v, r: self._read_other(k, v, r, path))
        except RefusedValueError as refusal:
            raise self._make_error(f"{path}{refusal.key}", refusal.problem) from refusal
        for key, text in _iter_texts(made):
            if not text.strip():
                raise self._make_error(path + key, "is empty: give a text, or leave it out")
        if isinstance(made, str) and rule.file and self._find_file is not None:
            return self._find_file(made, path)
        return made

    def _read_other(self, kind: Any, value: object, rule: SettingRule, path: str) -> Any:
        """Convert a mapping to its type: settings, a choice's option, or settings by any name."""
        if kind is ChosenOption:
            assert rule.choice is not None
            return self._read_chosen(rule.choice, value, path)
        if get_origin(kind) in (dict, Mapping):
            mapping = self._require_mapping(value, path)
            if rule.choice is not None:
                return self._read_by_choice(rule.choice, mapping, path)
            inner = get_args(kind)[1]
            return {
                str(key): self._read_value(inner, item, rule, join_keys(path, str(key)))
                for key, item in mapping.items()
            }
        if isinstance(kind, type) and issubclass(kind, Settings):
            return self.read(kind, value, path)
        return value

    def _read_chosen(self, choice: Choice, document: object, path: str) -> ChosenOption:
        """Read the option named under the choice's key, with the other keys as its settings."""
        mapping = self._require_mapping(document, path)
        if choice.key not in mapping:
            for key in mapping:
                if find_closest(key, [choice.key]):
                    raise self._make_key_error(key, {choice.key}, path)
            raise self._make_error(
                join_keys(path, choice.key), f"is missing; it is one of {', '.join(choice.names)}"
            )
        name = self._require_name(choice, mapping[choice.key], join_keys(path, choice.key))
        rest = {key: value for key, value in mapping.items() if key != choice.key}
        return ChosenOption(name, self._read_option_settings(choice, name, rest, path))

    def _read_chosen_here(
        self,
        settings: type,
        field: str,
        rule: SettingRule,
        mapping: Mapping[Any, Any],
        path: str,
        beside: set[str],
    ) -> tuple[set[str], ChosenOption]:
        """Return the keys of an option chosen among the keys of other settings, and the option."""
        choice = rule.choice
        assert choice is not None
        name = settings.__dataclass_fields__[field].default.name  # type: ignore[attr-defined]
        if choice.key in mapping:
            name = self._require_name(choice, mapping[choice.key], join_keys(path, choice.key))
        if rule.place == "named":
            for key in mapping:
                if choice.key not in mapping and key not in {*beside, *choice.names}:
                    raise self._make_key_error(key, {*beside, choice.key}, path)
            for other in choice.names:
                if other in mapping and other != name:
                    raise self._make_error(
                        join_keys(path, other), f"is for {choice.key} {other} only, not {name}"
                    )
            own = (
                self._read_settings(choice, name, mapping[name], path) if name in mapping else None
            )
            return {choice.key, name}, ChosenOption(name, own)
        rest = {k: v for k, v in mapping.items() if k not in beside and k != choice.key}
        return {choice.key, *rest}, ChosenOption(
            name, self._read_option_settings(choice, name, rest, path, beside)
        )

    def _read_settings(self, choice: Choice, name: str, document: object, path: str) -> Settings:
        return self.read(choice.load_settings(name), document, join_keys(path, name))

    def _read_option_settings(
        self,
        choice: Choice,
        name: str,
        mapping: dict[Any, Any],
        path: str,
        beside: Collection[str] = (),
    ) -> Settings | None:
        """Read the settings of an option; an error at a key names the option."""
        kind = f"{name} {choice.what}"
        article = "an" if kind[0] in "aeiou" and not kind.startswith("one") else "a"
        if not (mapping or choice.needs):
            return None  # so that its module need not be imported to say nothing of it
        own = choice.load_settings(name)
        rules = rules_of(own)
        for key in mapping:
            if key not in rules:
                others = [o for o in choice.importable if key in rules_of(choice.load_settings(o))]
                if not others:
                    raise self._make_key_error(key, {*rules, choice.key, *beside}, path)
                has = f"it has {', '.join(rules)}" if rules else "it has no settings"
                raise self._make_error(
                    join_keys(path, key),
                    f"{article} {kind} has no {key}; {has}, and {key} is for {' or '.join(others)}",
                )
        needed = [key for key in rules if _is_required(own, key)]
        for key in needed:
            if key not in mapping:
                raise self._make_error(
                    join_keys(path, key), f"is missing; {article} {kind} needs {', '.join(needed)}"
                )
        return self.read(own, mapping, path)

    def _read_by_choice(
        self, choice: Choice, mapping: Mapping[Any, Any], path: str
    ) -> dict[str, Any]:
        for name in mapping:
            if name not in choice.names:
                raise self._make_key_error(name, set(choice.names), path)
        return {
            name: self._read_settings(choice, name, block, path) for name, block in mapping.items()
        }

    def _require_name(self, choice: Choice, value: object, path: str) -> str:
        if not isinstance(value, str) or value not in choice.names:
            raise self._make_error(path, describe_unknown(value, choice.names))
        return value

    def _require_mapping(self, document: object, path: str) -> Mapping[Any, Any]:
        if not isinstance(document, Mapping):
            raise self._make_error(path, f"must be a mapping of keys, not {short_repr(document)}")
        return document

    def _make_key_error(self, key: object, known: set[str], path: str) -> UsSimError:
        like = find_closest(key, known)
        hint = f"did you mean `{like}`?" if like else f"known keys: {', '.join(sorted(known))}"
        hint = hint if known else "there is nothing to set here"
        key = str(key) if str(key).isprintable() else short_repr(key)
        return self._make_error(join_keys(path, key), f"unknown key; {hint}")

    def _make_error(self, path: str, problem: str) -> UsSimError:
        at = f"{path}: " if path else ""
        error = self._error(f"{self._origin}: {at}{problem}")
        error.key, error.problem = path, problem
        return error


def _iter_texts(value: object) -> Iterator[tuple[str, str]]:
    if isinstance(value, str):
        yield "", value
    elif isinstance(value, tuple):
        yield from ((f"[{i}]", item) for i, item in enumerate(value) if isinstance(item, str))


def join_keys(path: str, key: str) -> str:
    """Append a key to a path of keys."""
    return f"{path}.{key}" if path and key else path or key


def _is_required(settings: type, name: str) -> bool:
    field = settings.__dataclass_fields__[name]  # type: ignore[attr-defined]
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def dump_settings(settings: Settings) -> dict[str, Any]:
    """Return the settings that differ from their defaults, in SI units."""
    document: dict[str, Any] = {}
    for name, rule in rules_of(type(settings)).items():
        value, field = getattr(settings, name), type(settings).__dataclass_fields__[name]
        by_default = field.default
        if field.default_factory is not dataclasses.MISSING:
            by_default = field.default_factory()
        if value == by_default:
            continue
        if isinstance(value, ChosenOption):
            document |= _dump_chosen(name, value, rule)
        else:
            document[name] = _dump_value(value)
    return document


def _dump_chosen(name: str, chosen: ChosenOption, rule: SettingRule) -> dict[str, Any]:
    """Return the keys of the chosen option, at the place that its rule states."""
    assert rule.choice is not None
    own = dump_settings(chosen.given) if chosen.given is not None else {}
    key = {rule.choice.key: chosen.name}
    if rule.place == "within":
        return {name: key | own}
    return key | own if rule.place == "beside" else key | ({chosen.name: own} if own else {})


def _dump_value(value: Any) -> Any:
    if isinstance(value, Settings):
        return dump_settings(value)
    if isinstance(value, Mapping):
        return {str(key): _dump_value(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_dump_value(item) for item in value]
    return value
