"""The command `us-sim evaluate`."""

from __future__ import annotations

import argparse
import importlib
from functools import partial
from pathlib import Path
from typing import Any

from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.settings.registry import EVALUATIONS
from us_sim.settings.setting import Settings


def add_evaluate(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "evaluate", help="measure: CSV, pictures and a report", add_options=_add_subjects
    )


def _add_subjects(parser: argparse.ArgumentParser) -> None:
    subjects = parser.add_subparsers(required=True, metavar="|".join(EVALUATIONS))
    for name, option in EVALUATIONS.options.items():
        package = importlib.import_module(option.target.partition(":")[0].rpartition(".")[0])
        subjects.add_parser(name, help=package.__doc__, add_options=partial(_add_options, name))


def _add_options(name: str, parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="a part of it, in a few minutes")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(f"us_sim_{name}"),
        help="folder to write to, without a report so far; default: %(default)s",
    )
    add_setting_options(parser, EVALUATIONS.settings(name))
    parser.set_defaults(command=partial(_evaluate, name))


def _evaluate(name: str, args: argparse.Namespace) -> int:
    settings = read_settings(args, EVALUATIONS.settings(name))
    more = [] if type(settings) is Settings else [settings]
    return int(EVALUATIONS.load(name)(args.out, args.quick, *more))
