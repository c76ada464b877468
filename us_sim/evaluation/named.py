"""Tables of things by name, which refuse a name that they do not have in a sentence.

>>> from us_sim.evaluation.named import Named
>>> Named("animal", {"cat": 4, "crab": 10})["crap"]
Traceback (most recent call last):
...
us_sim.errors.SettingsError: animal 'crap' is not one of cat, crab; did you mean 'crab'?
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NoReturn, TypeVar

from us_sim.errors import SettingsError
from us_sim.settings.spelling import unknown

T = TypeVar("T")


class Named(dict[str, T]):
    """A dictionary that says which names there are where one is missing."""

    def __init__(self, what: str, values: Mapping[str, T]) -> None:
        super().__init__(values)
        self._what = what

    def __missing__(self, name: str) -> NoReturn:
        raise SettingsError(f"{self._what} {unknown(name, self)}")
