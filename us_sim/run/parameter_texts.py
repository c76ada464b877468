"""Texts that a parameter of a ROS node can carry.

>>> from us_sim.run.parameter_texts import require_texts
>>> require_texts({"file": "Übung 1.mcap", "loop": True, "topics": ["a", "b"]})
"""

from __future__ import annotations

from collections.abc import Mapping

from us_sim.errors import UsSimError


def require_texts(parameters: Mapping[str, object]) -> None:
    """Raise UsSimError for a text that is no UTF-8, as a file's name may be."""
    for name, value in parameters.items():
        for each in value if isinstance(value, list | tuple) else [value]:
            try:
                str(each).encode()
            except UnicodeEncodeError:
                raise UsSimError(
                    f"{name}: {each!r} is no text in UTF-8, which a parameter of a ROS node must "
                    f"be: rename the file, or use a locale with UTF-8"
                ) from None
