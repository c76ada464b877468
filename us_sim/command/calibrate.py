"""The command `us-sim calibrate`."""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.settings.registry import CALIBRATIONS


def add_calibrate(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "calibrate", help="find out where trackers and tools are", add_options=_add_calibrations
    )


def _add_calibrations(parser: argparse.ArgumentParser) -> None:
    calibrations = parser.add_subparsers(required=True, metavar="|".join(CALIBRATIONS))
    for name in CALIBRATIONS:
        settings = CALIBRATIONS.settings(name)
        calibration = calibrations.add_parser(name, help=settings.__doc__)
        add_setting_options(calibration, settings)
        calibration.set_defaults(command=partial(_calibrate, name))


def _calibrate(name: str, args: argparse.Namespace) -> int:
    from us_sim.progress import late_progress

    settings = read_settings(args, CALIBRATIONS.settings(name))
    print(CALIBRATIONS.load(name)(settings, late_progress(f"calibrate {name}")))
    return 0
