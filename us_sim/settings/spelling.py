"""Names and numbers for a person: suggestions for unknown names, singular and plural, columns.

>>> from us_sim.settings.spelling import align_columns, describe_unknown, format_count
>>> describe_unknown("fem_nonlinaer", ["fem", "fem_nonlinear"])
"'fem_nonlinaer' is not one of fem, fem_nonlinear; did you mean 'fem_nonlinear'?"
>>> format_count(1, "place"), format_count(0, "place"), format_count(2, "is", "are")
('1 place', '0 places', '2 are')
>>> align_columns([("topic", "count"), ("/tf", "7")])
['topic  count', '/tf        7']
"""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Collection, Iterable, Sequence

_MANY = 25
"""Names that are too many to list beside the one that was probably meant."""
_repr = reprlib.Repr()
_repr.maxstring = _repr.maxother = _LONGEST = 60


def format_count(count: int, one: str, several: str | None = None) -> str:
    """Write a number with its noun: ``1 frame``, ``2 frames``; ``several`` is another plural."""
    return f"{count} {one if count == 1 else several or f'{one}s'}"


def align_columns(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """Write each row as a line of aligned columns; those of ``left`` are flush left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if k in left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def short_repr(value: object) -> str:
    """Write a value in one line, cut where it is long."""
    text = " ".join(_repr.repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def find_closest(name: object, known: Iterable[str]) -> str | None:
    """Return the known name that is most like this one; None if none is."""
    found = difflib.get_close_matches(str(name), list(known), n=1)
    return found[0] if found else None


def describe_unknown(name: object, known: Iterable[str]) -> str:
    """Say that a name is not among the known ones, and which was probably meant."""
    known = list(known)
    like = find_closest(name, known)
    hint = f"; did you mean '{like}'?" if like else ""
    if len(known) > _MANY:
        return f"{short_repr(name)} is not known{hint}"
    return f"{short_repr(name)} is not one of {', '.join(known)}{hint}"
