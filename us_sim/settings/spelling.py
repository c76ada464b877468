"""What to say of a name that is not known.

>>> from us_sim.settings.spelling import unknown
>>> unknown("fem_nonlinaer", ["fem", "fem_nonlinear"])
"'fem_nonlinaer' is not one of fem, fem_nonlinear; did you mean 'fem_nonlinear'?"
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

__all__ = ["nearest", "unknown"]


def nearest(name: object, known: Iterable[str]) -> str | None:
    """The known name that is most like this one, if any is."""
    found = difflib.get_close_matches(str(name), list(known), n=1)
    return found[0] if found else None


def unknown(name: object, known: Iterable[str]) -> str:
    """That a name is not one of those known, and which was probably meant."""
    known = list(known)
    like = nearest(name, known)
    hint = f"; did you mean '{like}'?" if like else ""
    return f"{name!r} is not one of {', '.join(known)}{hint}"
