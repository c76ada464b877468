"""The command `us-sim bag info`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

__all__ = ["add_bag"]


def add_bag(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    bag = commands.add_parser("bag", help="look at recordings")
    bag_commands = bag.add_subparsers(required=True, metavar="COMMAND")
    info = bag_commands.add_parser("info", help="topics, types, counts and times of a recording")
    info.add_argument("file", type=Path)
    info.set_defaults(command=_info)


def _info(args: argparse.Namespace) -> int:
    from us_sim.recording.reader import read_bag
    from us_sim.recording.report import describe

    print(describe(read_bag(args.file)))
    return 0
