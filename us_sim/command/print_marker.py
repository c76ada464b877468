"""The command `us-sim print-marker`: sheets of markers at true scale."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from us_sim.errors import TrackingError

__all__ = ["add_print_marker"]

_LENGTHS = ("marker", "square", "separation")


def add_print_marker(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    parser = commands.add_parser("print-marker", help="PDF or PNG of markers, at true scale")
    parser.add_argument(
        "body", nargs="?", type=Path, help="file of a rigid body; default: one marker, or a board"
    )
    parser.add_argument("--id", type=int, default=0, metavar="N", help="number of the one marker")
    parser.add_argument(
        "--board", choices=("charuco", "grid"), help="a board in place of one marker"
    )
    parser.add_argument("--size", metavar="CxR", help="a board's columns and rows: 5x7")
    parser.add_argument("--marker", metavar="M", help="edge of a marker: '40 mm' (default)")
    parser.add_argument("--square", metavar="M", help="edge of a ChArUco board's square")
    parser.add_argument("--separation", metavar="M", help="between the markers of a grid")
    parser.add_argument("--dictionary", default="4X4_50", help="default: %(default)s")
    parser.add_argument("--paper", default="A4", help="A4 (default), A3 or letter")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help=".pdf, or .png for one sheet"
    )
    parser.set_defaults(command=_print_marker)


def _print_marker(args: argparse.Namespace) -> int:
    from us_sim.tracking.camera.marker_print import print_markers
    from us_sim.tracking.camera.rigid_body_file import read_rigid_body

    if args.body is not None:
        body = read_rigid_body(args.body, args.dictionary)
    else:
        body = _asked(args)
    pages = print_markers(body, args.out, args.paper)
    count = f"{len(pages)} sheets" if len(pages) > 1 else "1 sheet"
    print(f"{args.out}: {pages[0].foot}; {count} of {args.paper}, to be printed at 100 %")
    return 0


def _asked(args: argparse.Namespace) -> Any:
    """The body that the options describe."""
    from us_sim.tracking.camera.rigid_body import RigidBody
    from us_sim.tracking.camera.settings import MARKER_SIZE

    lengths = {"marker": 0.04}
    for name in _LENGTHS:
        given = getattr(args, name)
        if given is not None:
            try:
                lengths[name] = MARKER_SIZE.parse(given)
            except ValueError as error:
                raise TrackingError(f"--{name}: {error}") from error
    if args.board is None:
        return RigidBody.single(args.dictionary, args.id, lengths["marker"])
    needed = "square" if args.board == "charuco" else "separation"
    for name in ("size", needed):
        if getattr(args, name) is None:
            raise TrackingError(f"--board {args.board} needs --{name}")
    columns, _, rows = args.size.lower().partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise TrackingError(f"--size {args.size}: write columns and rows, e.g. 5x7")
    if args.board == "charuco":
        sizes = lengths["square"], lengths["marker"]
        return RigidBody.charuco(args.dictionary, int(columns), int(rows), *sizes)
    sizes = lengths["marker"], lengths["separation"]
    return RigidBody.grid(args.dictionary, int(columns), int(rows), *sizes)
