"""The command `us-sim import`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

_REPORT = Path("us_sim_import")


def add_import(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "import",
        help="de-identify files of scanners into a volume, a case or a sequence of images",
        add_options=_add_options,
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    from us_sim.command.setting_options import add_setting_options
    from us_sim.volume.deidentification.settings import ImportSettings

    parser.add_argument(
        "files",
        nargs="+",
        type=Path,
        help="DICOM files of one series, or a folder of them; or an MHA, NRRD or NIfTI volume",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="CASE|FILE",
        help="new folder of a case, volume (.nrrd, .mha, .nii, .nii.gz), or .igs.mha for 2D images",
    )
    parser.add_argument(
        "--report",
        type=Path,
        nargs="?",
        const=_REPORT,
        metavar="FOLDER",
        help=f"list what is kept, blanked and dropped, with a picture; default: {_REPORT}",
    )
    add_setting_options(parser, ImportSettings)
    parser.set_defaults(command=_import)


def _import(args: argparse.Namespace) -> int:
    from us_sim.command.setting_options import read_settings
    from us_sim.errors import UsSimError
    from us_sim.progress import late_progress
    from us_sim.volume.deidentification.importing import look_at
    from us_sim.volume.deidentification.report import (
        refuse_report,
        report_text,
        summary,
        write_report,
    )
    from us_sim.volume.deidentification.settings import ImportSettings

    if args.out is None and args.report is None:
        raise UsSimError("say where to with --out CASE|FILE, or --report to see what would be done")
    settings = read_settings(args, ImportSettings)
    if args.report is not None:
        refuse_report(args.report)
    found = look_at(args.files, args.out, settings)
    if args.report is not None:  # before what is refused: its picture shows what to say
        written = write_report(args.report, found.imported)
        print(report_text(found.imported))
        print(f"{written[0]} and {written[1].name} beside it, which may show a name")
    if args.out is not None:
        found.write(late_progress("import"))
        print(f"{args.out}: {summary(found.imported)}")
    return 0
