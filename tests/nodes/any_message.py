"""Any message that its type allows, with what lies at the edges more often than the rest.

`messages` draws all of a message. `nearly` draws a good message of which a few fields are not: it
gets past what looks at the first field only.
"""

import copy
import re
from array import array
from importlib import import_module

import numpy as np
from hypothesis import strategies as st

DOUBLES = [0.0, -0.0, 1.0, -1.0, 1e-6, 5e-324, 1e-200, 1e7, 1e200, 1.7e308]
SINGLES = [0.0, -0.0, 1.0, -1.0, 1e-6, 1e-45, 1e30, 3.4e38]
LARGEST = float(np.float32(3.4e38))  # rclpy itself takes a little more, but not all of it
BEYOND = [float("nan"), float("inf"), float("-inf")]
WHOLE = re.compile(r"(u?)int(8|16|32|64)")
FEW = 4  # elements of a sequence, mostly

numbers = {
    "boolean": st.booleans(),
    "octet": st.binary(min_size=1, max_size=1),
    "char": st.integers(0, 255),
    "double": st.sampled_from([*DOUBLES, *(-x for x in DOUBLES), *BEYOND]) | st.floats(),
    "float": st.sampled_from([float(np.float32(x)) for x in (*SINGLES, *BEYOND)])
    | st.floats(-LARGEST, LARGEST, width=32),
}
texts = st.sampled_from(["", "patient", "probe", "x", "mono8", "a" * 300, "ä", "a\nb"]) | st.text(
    st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=9
)


def whole(kind):
    """Integers of a kind such as ``uint32``; those near powers of two are where sums overflow."""
    unsigned, bits = WHOLE.fullmatch(kind).groups()
    low, high = (0, 2 ** int(bits)) if unsigned else (-(2 ** (int(bits) - 1)), 2 ** (int(bits) - 1))
    edges = {low, high - 1, 0, 1, 3, 999_999_999, 1_000_000_000, 2**31 - 4, 2**31, 2**31 + 1, -1}
    inside = sorted(edge for edge in edges if low <= edge < high)
    return st.sampled_from(inside) | st.integers(low, high - 1)


def values(kind):
    """Values of a field, by what ``get_fields_and_field_types`` calls its type."""
    if many := re.fullmatch(r"sequence<(.+?)(?:, (\d+))?>", kind):
        return _sequences(many[1], 0, int(many[2] or FEW))
    if many := re.fullmatch(r"(.+)\[(\d+)\]", kind):
        return _sequences(many[1], int(many[2]), int(many[2]))
    if kind.startswith(("string", "wstring")):
        return texts
    if WHOLE.fullmatch(kind):
        return whole(kind)
    return numbers[kind] if kind in numbers else any_of(_class(kind))


def any_of(cls):
    """All messages of a type."""
    return st.builds(cls, **{name: values(kind) for name, kind in _fields(cls).items()})


def nearly(good):
    """Messages that differ from a good one in one to three of their fields."""
    places = list(_places(good))

    def changed(changes):
        message = copy.deepcopy(good)
        for (*way, name), value in changes:
            owner = message
            for step in way:
                owner = owner[step] if isinstance(step, int) else getattr(owner, step)
            if isinstance(name, int):
                owner[name] = value
            else:
                setattr(owner, name, value)
        return message

    drawn = st.sampled_from(places).flatmap(
        lambda place: st.tuples(st.just(place[0]), values(place[1]))
    )
    # Outer fields first: what they bring may be shorter than what an inner one is in.
    return st.lists(drawn, min_size=1, max_size=3, unique_by=lambda change: change[0][0]).map(
        changed
    )


def _sequences(kind, least, most):
    if kind in ("uint8", "char", "octet"):
        return st.binary(min_size=least, max_size=max(most, least)).map(
            lambda data: [bytes([x]) for x in data] if kind == "octet" else array("B", data)
        )
    return st.lists(values(kind), min_size=least, max_size=most)


def _places(message, way=()):
    """Where a message's fields are, those of its parts too, and their types."""
    for name, kind in _fields(type(message)).items():
        yield (*way, name), kind
        value = getattr(message, name)
        if "/" in kind and not isinstance(value, list):
            yield from _places(value, (*way, name))
        elif "/" in kind:
            for number, part in enumerate(value[:FEW]):
                yield from _places(part, (*way, name, number))


def _fields(cls):
    return cls.get_fields_and_field_types()


def _class(kind):
    package, name = kind.split("/")[0], kind.split("/")[-1]
    return getattr(import_module(f"{package}.msg"), name)
