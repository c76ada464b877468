"""The command `us-sim reconstruct`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.progress import late_progress

if TYPE_CHECKING:
    from us_sim.volume.reconstruction.reconstruction import Rest
    from us_sim.volume.reconstruction.settings import ImagePart
    from us_sim.volume.sequences.sweep import Sweep


def add_reconstruct(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "reconstruct", help="make a volume or a case of a tracked sweep", add_options=_add_options
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    from us_sim.command.reconstruct_sweep import SweepSettings
    from us_sim.volume.reconstruction.settings import Compounding, ImagePart

    for settings in (SweepSettings, Compounding, ImagePart):
        add_setting_options(parser, settings)
    parser.add_argument(
        "--undo-pressure",
        metavar="SCENE",
        help="place the images where the tissue of this scene lies while no probe presses it; the "
        "sweep's reference frame is the scene's patient",
    )
    parser.set_defaults(command=_reconstruct)


def _reconstruct(args: argparse.Namespace) -> int:
    from us_sim.command.reconstruct_sweep import SweepSettings, reconstruct_sweep
    from us_sim.volume.reconstruction.settings import Compounding, ImagePart

    settings = read_settings(args, SweepSettings)
    compounding, part = read_settings(args, Compounding), read_settings(args, ImagePart)
    rest_of = None
    if args.undo_pressure is not None:

        def rest_of(sweep: Sweep, part: ImagePart) -> Rest:
            from us_sim.scene.reading import load_scene
            from us_sim.scene.rest_placement import rest_placement

            scene = load_scene(args.undo_pressure)
            return rest_placement(scene, sweep, part)

    progress = late_progress(f"reconstruct {Path(settings.sweep).name}")
    print(reconstruct_sweep(settings, compounding, part, rest_of=rest_of, progress=progress))
    return 0
