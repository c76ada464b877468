"""Settings from a mapping of keys, as a file holds it, every key and value checked; and back.

>>> from us_sim.settings.reading import Reader, document_of
>>> from us_sim.skin.settings import SkinSettings
>>> skin = Reader("my.yaml").read(SkinSettings, {"spacing": "5 mm", "size": ["12 cm", "10 cm"]})
>>> document_of(skin)
{'size': [0.12, 0.1], 'spacing': 0.005}
>>> Reader("my.yaml").read(SkinSettings, {"spacign": "5 mm"}, "skin")
Traceback (most recent call last):
...
us_sim.errors.SettingsError: my.yaml: skin.spacign: unknown key; did you mean `spacing`?
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, TypeVar, get_args, get_origin

from us_sim.errors import SettingsError, UsSimError
from us_sim.settings.choice import Choice, Chosen
from us_sim.settings.setting import Refusal, Rule, Settings, convert, kinds_of, rules_of
from us_sim.settings.spelling import nearest, shown, unknown

S = TypeVar("S", bound=Settings)


class Reader:
    """Reads settings from one document.

    Args:
        origin: the document, for sentences: a file's path.
        find_file: from the text of a setting that names a file, and that setting's path of keys,
            to the text to keep; it raises ``error`` where there is no such file.
        error: what is raised.
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
        """An instance of ``settings`` from a mapping.

        Args:
            document: the mapping, as YAML or JSON gives it.
            path: the keys that lead to it, with dots.

        Raises:
            SettingsError: or the reader's own error: a key is unknown or missing, or a value will
                not do; one sentence with the document, the key and what would be right.
        """
        mapping = self._mapping(document, path)
        rules, kinds = rules_of(settings), kinds_of(settings)
        values: dict[str, Any] = {}
        here = {n for n, rule in rules.items() if rule.choice and rule.place != "within"}
        known = set(rules) - here
        for name in here:
            rule = rules[name]
            taken, values[name] = self._chosen_here(settings, name, rule, mapping, path, known)
            known |= taken
        for key in mapping:
            if key not in known:
                raise self._unknown_key(key, known, path)
        for name, rule in rules.items():
            at = joined(path, name)
            if name in mapping and name not in values:
                values[name] = self._value(kinds[name], mapping[name], rule, at)
            elif name not in values and _is_required(settings, name):
                raise self._refused(at, "is missing")
        return self._made(settings, values, mapping, path)

    def _made(
        self, settings: type[S], values: dict[str, Any], given: Iterable[str], path: str
    ) -> S:
        try:
            made = settings(**values)
        except UsSimError as error:
            if not error.problem:
                raise self._error(f"{self._origin}: {error}") from error
            raise self._refused(joined(path, error.key), error.problem) from error
        for name in rules_of(settings):
            problem = made.inapplicable(name)
            if problem and name in given:  # also where it is the default
                raise self._refused(joined(path, name), problem)
        return made

    def _value(self, kind: Any, value: object, rule: Rule, path: str) -> Any:
        listed = get_args(kind)[0] if get_origin(kind) is tuple else None
        if isinstance(listed, type) and issubclass(listed, Settings):
            if not isinstance(value, list):
                raise self._refused(path, f"must be a list, not {shown(value)}")
            return tuple(self.read(listed, each, f"{path}[{i}]") for i, each in enumerate(value))
        try:
            made = convert(kind, value, rule, lambda k, v, r: self._other(k, v, r, path))
        except Refusal as refusal:
            raise self._refused(f"{path}{refusal.key}", refusal.problem) from refusal
        for key, text in _texts(made):
            if not text.strip():
                raise self._refused(path + key, "is empty: give a text, or leave it out")
        if isinstance(made, str) and rule.file and self._find_file is not None:
            return self._find_file(made, path)
        return made

    def _other(self, kind: Any, value: object, rule: Rule, path: str) -> Any:
        """Convert a mapping to its type: settings, a choice's option, or settings by any name."""
        if kind is Chosen:
            assert rule.choice is not None
            return self._chosen(rule.choice, value, path)
        if get_origin(kind) in (dict, Mapping):
            mapping = self._mapping(value, path)
            if rule.choice is not None:
                return self._by_choice(rule.choice, mapping, path)
            inner = get_args(kind)[1]
            return {
                str(key): self._value(inner, item, rule, joined(path, str(key)))
                for key, item in mapping.items()
            }
        if isinstance(kind, type) and issubclass(kind, Settings):
            return self.read(kind, value, path)
        return value

    def _chosen(self, choice: Choice, document: object, path: str) -> Chosen:
        """The option named under the choice's key, with the other keys as its settings."""
        mapping = self._mapping(document, path)
        if choice.key not in mapping:
            for key in mapping:
                if nearest(key, [choice.key]):
                    raise self._unknown_key(key, {choice.key}, path)
            raise self._refused(
                joined(path, choice.key), f"is missing; it is one of {', '.join(choice.names)}"
            )
        name = self._name(choice, mapping[choice.key], joined(path, choice.key))
        rest = {key: value for key, value in mapping.items() if key != choice.key}
        return Chosen(name, self._settings_of(choice, name, rest, path))

    def _chosen_here(
        self,
        settings: type,
        field: str,
        rule: Rule,
        mapping: Mapping[Any, Any],
        path: str,
        beside: set[str],
    ) -> tuple[set[str], Chosen]:
        """The option chosen among the keys of other settings, and the keys that are about it."""
        choice = rule.choice
        assert choice is not None
        default = settings.__dataclass_fields__[field].default  # type: ignore[attr-defined]
        name = default.name
        if choice.key in mapping:
            name = self._name(choice, mapping[choice.key], joined(path, choice.key))
        if rule.place == "named":
            for key in mapping:
                if choice.key not in mapping and key not in {*beside, *choice.names}:
                    raise self._unknown_key(key, {*beside, choice.key}, path)
            for other in choice.names:
                if other in mapping and other != name:
                    raise self._refused(
                        joined(path, other), f"is for {choice.key} {other} only, not {name}"
                    )
            own = mapping.get(name)
            made = None if name not in mapping else self._settings(choice, name, own, path)
            return {choice.key, name}, Chosen(name, made)
        rest = {k: v for k, v in mapping.items() if k not in beside and k != choice.key}
        return {choice.key, *rest}, Chosen(
            name, self._settings_of(choice, name, rest, path, beside)
        )

    def _settings(self, choice: Choice, name: str, document: object, path: str) -> Settings:
        return self.read(choice.settings(name), document, joined(path, name))

    def _settings_of(
        self,
        choice: Choice,
        name: str,
        mapping: dict[Any, Any],
        path: str,
        beside: Collection[str] = (),
    ) -> Settings | None:
        """The settings of an option, whose keys say of which option they are."""
        kind = f"{name} {choice.what}"
        article = "an" if kind[0] in "aeiou" and not kind.startswith("one") else "a"
        if not (mapping or choice.needs):
            return None  # so that its module need not be imported to say nothing of it
        own = choice.settings(name)
        rules = rules_of(own)
        for key in mapping:
            if key not in rules:
                others = [o for o in choice.importable if key in rules_of(choice.settings(o))]
                if not others:
                    raise self._unknown_key(key, {*rules, choice.key, *beside}, path)
                has = f"it has {', '.join(rules)}" if rules else "it has no settings"
                raise self._refused(
                    joined(path, key),
                    f"{article} {kind} has no {key}; {has}, and {key} is for {' or '.join(others)}",
                )
        needed = [key for key in rules if _is_required(own, key)]
        for key in needed:
            if key not in mapping:
                raise self._refused(
                    joined(path, key), f"is missing; {article} {kind} needs {', '.join(needed)}"
                )
        return self.read(own, mapping, path)

    def _by_choice(self, choice: Choice, mapping: Mapping[Any, Any], path: str) -> dict[str, Any]:
        for name in mapping:
            if name not in choice.names:
                raise self._unknown_key(name, set(choice.names), path)
        return {name: self._settings(choice, name, block, path) for name, block in mapping.items()}

    def _name(self, choice: Choice, value: object, path: str) -> str:
        if not isinstance(value, str) or value not in choice.names:
            raise self._refused(path, unknown(value, choice.names))
        return value

    def _mapping(self, document: object, path: str) -> Mapping[Any, Any]:
        if not isinstance(document, Mapping):
            raise self._refused(path, f"must be a mapping of keys, not {shown(document)}")
        return document

    def _unknown_key(self, key: object, known: set[str], path: str) -> UsSimError:
        like = nearest(key, known)
        hint = f"did you mean `{like}`?" if like else f"known keys: {', '.join(sorted(known))}"
        hint = hint if known else "there is nothing to set here"
        key = str(key) if str(key).isprintable() else shown(key)
        return self._refused(joined(path, key), f"unknown key; {hint}")

    def _refused(self, path: str, problem: str) -> UsSimError:
        at = f"{path}: " if path else ""
        error = self._error(f"{self._origin}: {at}{problem}")
        error.key, error.problem = path, problem
        return error


def _texts(value: object) -> Iterator[tuple[str, str]]:
    if isinstance(value, str):
        yield "", value
    elif isinstance(value, tuple):
        yield from ((f"[{i}]", item) for i, item in enumerate(value) if isinstance(item, str))


def joined(path: str, key: str) -> str:
    """A path of keys, one key longer."""
    return f"{path}.{key}" if path and key else path or key


def _is_required(settings: type, name: str) -> bool:
    field = settings.__dataclass_fields__[name]  # type: ignore[attr-defined]
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def document_of(settings: Settings) -> dict[str, Any]:
    """The settings that differ from their defaults, in SI units."""
    document: dict[str, Any] = {}
    fields = {field.name: field for field in dataclasses.fields(settings)}
    for name, rule in rules_of(type(settings)).items():
        value, field = getattr(settings, name), fields[name]
        by_default = field.default
        if field.default_factory is not dataclasses.MISSING:
            by_default = field.default_factory()
        if value == by_default:
            continue
        if isinstance(value, Chosen):
            document |= _chosen(name, value, rule)
        else:
            document[name] = _plain(value)
    return document


def _chosen(name: str, chosen: Chosen, rule: Rule) -> dict[str, Any]:
    """The keys of the chosen option, at the place that its rule states."""
    assert rule.choice is not None
    own = document_of(chosen.given) if chosen.given is not None else {}
    key = {rule.choice.key: chosen.name}
    if rule.place == "within":
        return {name: key | own}
    return key | own if rule.place == "beside" else key | ({chosen.name: own} if own else {})


def _plain(value: Any) -> Any:
    if isinstance(value, Settings):
        return document_of(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value
