"""The command `us-sim print-marker`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.settings.spelling import counted


def add_print_marker(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "print-marker", help="PDF or PNG of markers, at true scale", add_options=_add_options
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    from us_sim.tracking.camera.marker_print import PrintSettings

    parser.add_argument(
        "body", nargs="?", type=Path, help="file of a rigid body; default: one marker, or a board"
    )
    add_setting_options(parser, PrintSettings)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help=".pdf, or .png for one sheet"
    )
    parser.set_defaults(command=_print_marker)


def _print_marker(args: argparse.Namespace) -> int:
    from us_sim.tracking.camera.marker_print import PrintSettings, print_markers
    from us_sim.tracking.camera.rigid_body import read_rigid_body

    asked = read_settings(args, PrintSettings)
    body = read_rigid_body(args.body, asked.dictionary) if args.body else asked.body()
    pages = print_markers(body, args.out, asked.paper)
    count = counted(len(pages), "sheet")
    print(f"{args.out}: {pages[0].foot}; {count} of {asked.paper}, to be printed at 100 %")
    return 0
