"""The command `us-sim compile`."""

from __future__ import annotations

import argparse
from typing import Any


def add_compile(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    compiling = commands.add_parser(
        "compile", help="compile all numerical kernels now, so that no first run waits for it"
    )
    compiling.set_defaults(command=_compile)


def _compile(_: argparse.Namespace) -> int:
    from us_sim.run.compilation import compile_kernels

    return compile_kernels()
