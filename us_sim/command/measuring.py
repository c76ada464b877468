"""The commands `evaluate`, `calibrate` and `print-marker`."""

from __future__ import annotations

import argparse
import importlib
from functools import partial
from pathlib import Path

from us_sim.command.options import add_setting_options, read_settings
from us_sim.progress import late_progress
from us_sim.settings.registry import CALIBRATIONS, EVALUATIONS
from us_sim.settings.setting import Settings
from us_sim.settings.spelling import format_count


def evaluate_options(parser: argparse.ArgumentParser) -> None:
    """Add the measurements of `us-sim evaluate`."""
    subjects = parser.add_subparsers(required=True, metavar="MEASUREMENT")
    for name, option in EVALUATIONS.options.items():
        package = importlib.import_module(option.target.partition(":")[0].rpartition(".")[0])
        add_options = partial(_add_subject_options, name)
        subjects.add_parser(name, help=package.__doc__, add_options=add_options)


def _add_subject_options(name: str, parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="a part of it, in a few minutes")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(f"us_sim_{name}"),
        help="folder to write to, without a report so far; default: %(default)s",
    )
    add_setting_options(parser, EVALUATIONS.load_settings(name))
    parser.set_defaults(command=partial(_evaluate, name))


def _evaluate(name: str, args: argparse.Namespace) -> int:
    settings = read_settings(args, EVALUATIONS.load_settings(name))
    more = [] if type(settings) is Settings else [settings]
    return int(EVALUATIONS.load(name)(args.out, args.quick, *more))


def calibrate_options(parser: argparse.ArgumentParser) -> None:
    """Add the calibrations of `us-sim calibrate`."""
    calibrations = parser.add_subparsers(required=True, metavar="CALIBRATION")
    for name in CALIBRATIONS:
        settings = CALIBRATIONS.load_settings(name)
        calibration = calibrations.add_parser(name, help=settings.__doc__)
        add_setting_options(calibration, settings)
        calibration.set_defaults(command=partial(_calibrate, name))


def _calibrate(name: str, args: argparse.Namespace) -> int:
    settings = read_settings(args, CALIBRATIONS.load_settings(name))
    print(CALIBRATIONS.load(name)(settings, late_progress(f"calibrate {name}")))
    return 0


def print_marker_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim print-marker`."""
    parser.add_argument("body", type=Path, help="file of the markers: a rigid body, or a board")
    parser.add_argument("--paper", default="A4", help="of the sheets: A4, A3 or letter")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help=".pdf, or .png for one sheet"
    )
    parser.set_defaults(command=_print_marker)


def _print_marker(args: argparse.Namespace) -> int:
    from us_sim.tracking.camera.marker_print import print_markers
    from us_sim.tracking.camera.rigid_body import read_rigid_body

    pages = print_markers(read_rigid_body(args.body), args.out, args.paper)
    count = format_count(len(pages), "sheet")
    print(f"{args.out}: {pages[0].foot}; {count} of {args.paper}, to be printed at 100 %")
    return 0
