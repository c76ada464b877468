"""Commands whose options are known, and whose modules are imported, when they are chosen."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any


class ChosenParser(argparse.ArgumentParser):
    """A parser that has its options added when it is used for the first time.

    Args:
        add_options: adds them to the parser that it is called with.
    """

    def __init__(
        self,
        *args: Any,
        add_options: Callable[[argparse.ArgumentParser], None] | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(*args, **settings)
        self._add_options = add_options

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """As argparse does, with the options added."""
        add_options, self._add_options = self._add_options, None
        if add_options is not None:
            add_options(self)
        return super().parse_known_args(args, namespace)
