"""From settings to a mapping of keys as a file holds it: what `us_sim.settings.reading` reads.

>>> from us_sim.settings.reading import Reader
>>> from us_sim.settings.writing import document_of
>>> from us_sim.skin.settings import SkinSettings
>>> skin = Reader("my.yaml").read(SkinSettings, {"spacing": "5 mm", "size": ["12 cm", "10 cm"]})
>>> document_of(skin)
{'size': [0.12, 0.1], 'spacing': 0.005}
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from us_sim.settings.choice import Chosen
from us_sim.settings.setting import Rule, Settings, rules_of


def document_of(settings: Settings) -> dict[str, Any]:
    """The settings that are not what they would be without being said, in SI units."""
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
    """The keys of what was chosen, where its rule says that they stand."""
    assert rule.choice is not None
    own = document_of(chosen.given) if chosen.given is not None else {}
    key = {rule.choice.key: chosen.name}
    if rule.place == "within":
        return {name: key | own}
    return key | own if rule.place == "beside" else key | ({chosen.name: own} if own else {})


def _plain(value: Any) -> Any:
    """A value in the types that YAML has."""
    if isinstance(value, Settings):
        return document_of(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value
