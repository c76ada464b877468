"""The command `us-sim cases`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_cases(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    cases = commands.add_parser("cases", help="list cases: what they are of, and how to scan them")
    cases.add_argument(
        "folders",
        nargs="*",
        type=Path,
        metavar="DIR",
        help="folder of cases, or a case; default: those in US_SIM_CASES, or in the user's data "
        "folder",
    )
    cases.add_argument(
        "--picture", type=Path, metavar="FILE", help="write what the probe sees in each as a PNG"
    )
    cases.set_defaults(command=_cases)


def _cases(args: argparse.Namespace) -> int:
    from us_sim.errors import UsSimError
    from us_sim.volume.cases.case import case_roots, cases_in, listed, table

    if args.picture is not None and args.picture.suffix.lower() != ".png":
        raise UsSimError(f"--picture {args.picture}: must be a file that ends in .png")
    roots = args.folders or [root for root in case_roots() if root.is_dir()]
    folders = [folder for root in roots for folder in cases_in(root)]
    if not folders:
        where = ", ".join(map(str, args.folders or case_roots()))
        print(f"no case in {where}; `us-sim import` and `us-sim reconstruct` make one")
        return 0
    rows = [listed(folder) for folder in folders]
    print(table(rows))
    if args.picture is not None:
        from us_sim.demo.case_pictures import picture_cases

        picture_cases([row.folder for row in rows if not row.problem], args.picture)
        print(args.picture)
    return 1 if any(row.problem for row in rows) else 0
