"""Parameters of nodes as a page shows them: in the unit a person reads, with range and meaning.

>>> from us_sim.viewer.parameters import Kind, Parameter
>>> depth = Parameter(
...     "slice_interpolator", "depth", Kind.NUMBER, 0.04, unit="mm", size=1e-3, limits=(0.005, 0.4)
... )
>>> depth.value, depth.low, depth.high, depth.raw_of(45)
(40.0, 5.0, 400.0, 0.045)
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from us_sim.errors import SettingsError, UsSimError
from us_sim.settings.spelling import shown

_DIGITS = 12  # of a number that is shown: fewer than a float has, so that rounding is not seen
_AT_THE_END = 1e-11  # how far from the end of its range, relatively, a number may be by rounding
_NAMES = {"m mode": "M-mode", "nyquist": "Nyquist"}  # that are written otherwise than other words
_WHOLE = 2**63  # whole numbers from here on do not fit into a parameter


class Kind(Enum):
    """The types of parameters; each with the name of a control for it."""

    TRUTH = "truth"
    WHOLE = "whole"
    NUMBER = "number"
    TEXT = "text"
    WHOLES = "wholes"
    NUMBERS = "numbers"
    TEXTS = "texts"
    OTHER = "other"  # without a value, or of a type that no control is for

    @property
    def is_list(self) -> bool:
        """Whether its value is a tuple."""
        return self in (Kind.WHOLES, Kind.NUMBERS, Kind.TEXTS)


class State(Enum):
    """Progress of asking a node for its parameters."""

    ABSENT = "is not running"
    ASKED = "is being asked for its parameters"
    SILENT = "does not answer what its parameters are"
    THERE = ""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a node, with its value as the node has it and as a person reads it."""

    node: str  # name within the namespace
    name: str
    kind: Kind
    raw: Any  # in SI units; lists are tuples
    unit: str = ""  # that a person reads
    size: float = 1.0  # SI units in one of ``unit``
    limits: tuple[float, float] | None = None  # in SI units
    choices: tuple[str, ...] = ()  # the only texts that will do
    meanings: Mapping[str, str] = field(default_factory=dict)  # of choices, as far as told
    may_be_nothing: bool = False  # and is where ``raw`` is 0, empty, or a list of those
    description: str = ""
    is_live: bool = True  # may change while the node runs

    @property
    def value(self) -> Any:
        """In ``unit``; None is nothing."""
        if self.may_be_nothing and _is_nothing(self.raw):
            return None
        if self.kind is Kind.NUMBER:
            return self._shown(self.raw)
        if self.kind is Kind.NUMBERS:
            return tuple(self._shown(each) for each in self.raw)
        return self.raw

    @property
    def low(self) -> float | None:
        """The smallest number that will do, in ``unit``."""
        return self._shown(self.limits[0]) if self.limits else None

    @property
    def high(self) -> float | None:
        """The largest number that will do, in ``unit``."""
        return self._shown(self.limits[1]) if self.limits else None

    @property
    def group(self) -> str:
        """Its name up to the last dot."""
        return self.name.rpartition(".")[0]

    @property
    def label(self) -> str:
        """The last part of its name in words."""
        return in_words(self.name.rpartition(".")[2])

    def raw_of(self, value: Any) -> Any:
        """The value in SI units of one that a person has set, in ``unit``.

        Raises:
            SettingsError: it is no value of this kind, or outside the range.
        """
        if value is None or (value == "" and self.kind is not Kind.TEXT):
            if not self.may_be_nothing:
                raise SettingsError(f"{self.label} needs a value")
            return self._nothing()
        if self.kind is Kind.TRUTH and isinstance(value, bool):
            return value
        if self.kind is Kind.TEXT and isinstance(value, str):
            return value
        if self.kind is Kind.WHOLE:
            return self._in_range(self._whole(value))
        if self.kind is Kind.NUMBER:
            return self._in_range(self._number(value))
        if self.kind.is_list and isinstance(value, list | tuple):
            return tuple(self._item(each) for each in value)
        raise SettingsError(f"{self.label}: {shown(value)} is not what it can be set to")

    def with_raw(self, raw: Any) -> Parameter:
        """The parameter after it was set."""
        return dataclasses.replace(self, raw=raw)

    def _shown(self, number: float) -> float:
        return float(f"{number / self.size:.{_DIGITS}g}")

    def _nothing(self) -> Any:
        if self.kind is Kind.NUMBERS:
            return tuple(0.0 for _ in self.raw) or (0.0,)
        nothing = {Kind.WHOLE: 0, Kind.NUMBER: 0.0, Kind.TEXT: "", Kind.WHOLES: (), Kind.TEXTS: ()}
        return nothing.get(self.kind)

    def _item(self, value: Any) -> Any:
        if self.kind is Kind.TEXTS:
            return str(value)
        return self._whole(value) if self.kind is Kind.WHOLES else self._number(value)

    def _whole(self, value: Any) -> int:
        number = self._finite(value)
        if number != int(number):
            raise SettingsError(f"{self.label}: {number:g} is not a whole number")
        if abs(number) >= _WHOLE:
            raise SettingsError(f"{self.label}: {number:g} is too large for a whole number")
        return int(number)

    def _number(self, value: Any) -> float:
        number = self._finite(value)
        per_unit = round(1.0 / self.size)
        if per_unit > 1 and math.isclose(1.0 / self.size, per_unit, rel_tol=1e-15):
            number /= per_unit  # 7 mm / 1000 is the float 0.007, and 7 · 1e-3 is not
        else:
            number *= self.size
        for end in self.limits or ():
            if math.isclose(number, end, rel_tol=_AT_THE_END):
                return end
        return number

    def _in_range(self, raw: Any) -> Any:
        if self.limits and not self.limits[0] <= raw <= self.limits[1]:
            unit = f" {self.unit}" if self.unit else ""
            raise SettingsError(
                f"{self._shown(raw):g}{unit} is outside {self.low:g} to {self.high:g}{unit}"
            )
        return raw

    def _finite(self, value: Any) -> float:
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if isinstance(value, bool) or not math.isfinite(number):
            raise SettingsError(f"{self.label}: {shown(value)} is not a number")
        return number


@dataclass(frozen=True)
class NodeParameters:
    """The parameters of one node, as far as they are known."""

    node: str
    state: State = State.ABSENT
    parameters: Mapping[str, Parameter] = field(default_factory=dict)  # by name, as declared


def in_words(name: str) -> str:
    """A parameter's name, or a group's, as a person reads it.

    >>> in_words("colour.nyquist_velocity"), in_words("m_mode")
    ('colour · Nyquist velocity', 'M-mode')
    """
    words = name.replace("_", " ").replace(".", " · ")
    for plain, written in _NAMES.items():
        words = words.replace(plain, written)
    return words


def _is_nothing(raw: Any) -> bool:
    return not any(raw) if isinstance(raw, tuple) else raw in (0, "")


Send = Callable[[Parameter, Any], "Future[str]"]
"""Sets a parameter to a value in SI units; the future holds why not, or nothing."""


class ParameterBoard:
    """The newest parameters of each node, and the nodes that pages show; for any thread.

    Args:
        on_watch: called when pages begin to show a node, or no longer do.
        send: asks a node to set a parameter.
    """

    def __init__(self, on_watch: Callable[[], None] = lambda: None, send: Send | None = None):
        self._on_watch, self._send = on_watch, send
        self._watched: Counter[str] = Counter()
        self._known: dict[str, NodeParameters] = {}
        self._lock = threading.Lock()

    @property
    def watched(self) -> set[str]:
        """The names of the nodes that pages show."""
        with self._lock:
            return set(self._watched)

    def watch(self, node: str) -> None:
        """Follow a node's parameters, until `unwatch`."""
        with self._lock:
            self._watched[node] += 1
            first = self._watched[node] == 1
        if first:
            self._on_watch()

    def unwatch(self, node: str) -> None:
        """Follow them no longer."""
        with self._lock:
            self._watched[node] -= 1
            last = self._watched[node] <= 0
            if last:
                del self._watched[node]
        if last:
            self._on_watch()

    def of(self, node: str) -> NodeParameters:
        """The parameters of a node; another object whenever they have changed."""
        with self._lock:
            return self._known.get(node) or NodeParameters(node)

    def tell(self, known: NodeParameters) -> None:
        """Keep what is newest of a node; another object only if it differs."""
        with self._lock:
            if self._known.get(known.node) != known:
                self._known[known.node] = known

    def set(self, node: str, name: str, value: Any) -> Future[str]:
        """Set a parameter to a value in the unit that is shown; None is nothing.

        The future holds the reason if it is refused, and an empty text if not.
        """
        parameter = self.of(node).parameters.get(name)
        if parameter is None or self._send is None:
            return _refused(f"{node} has no parameter {name} at present")
        try:
            raw = parameter.raw_of(value)
        except UsSimError as error:
            return _refused(str(error))
        return self._send(parameter, raw)


def _refused(reason: str) -> Future[str]:
    future: Future[str] = Future()
    future.set_result(reason)
    return future
