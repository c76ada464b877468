"""The command `us-sim segment`."""

from __future__ import annotations

import argparse
from typing import Any

from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.progress import late_progress


def add_segment(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "segment",
        help="structures of a case from labels, seeds or a search, and their surfaces",
        add_options=_add_options,
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    from us_sim.volume.segmentation.settings import SegmentRequest
    from us_sim.volume.surfaces.settings import SurfaceSettings

    add_setting_options(parser, SegmentRequest)
    add_setting_options(parser, SurfaceSettings)
    parser.set_defaults(command=_segment)


def _segment(args: argparse.Namespace) -> int:
    from us_sim.command.segment_case import segment_as_asked
    from us_sim.volume.segmentation.settings import SegmentRequest
    from us_sim.volume.surfaces.settings import SurfaceSettings

    asked = read_settings(args, SegmentRequest)
    surfaces = read_settings(args, SurfaceSettings)
    print(segment_as_asked(asked, surfaces, late_progress("segment")))
    return 0
