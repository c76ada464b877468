"""The command `us-sim view`."""

from __future__ import annotations

import argparse
from typing import Any


def add_view(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "view", help="take the probe in a browser, and see what it images", add_options=_add_options
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    from us_sim.command.run import RunSettings
    from us_sim.command.scene_options import (
        add_network_option,
        add_path_option,
        add_scene_options,
        add_supervision_options,
        add_viewer_options,
    )
    from us_sim.command.setting_options import add_setting_options

    parser.add_argument(
        "scene", nargs="?", help="scene file, or name of an installed one; default: upper_arm"
    )
    add_viewer_options(parser)
    add_setting_options(parser, RunSettings, ("record",))
    add_path_option(
        parser, "play this bag's probe path, and hold the probe at its end until it is taken"
    )
    parser.add_argument("--loop", action="store_true", help="play the path again and again")
    parser.add_argument(
        "--tracker",
        action="store_true",
        help="take poses from the scene's own tracker; default: from the hand in the page, and "
        "from whatever else publishes tracker/pose",
    )
    parser.add_argument(
        "--attach", action="store_true", help="show a simulation that runs already, anywhere"
    )
    add_scene_options(parser)
    add_supervision_options(parser)
    add_network_option(parser)
    parser.set_defaults(command=_view)


def _view(args: argparse.Namespace) -> int:
    from us_sim.command.run import RunSettings
    from us_sim.command.scene_options import node_parameters, scene_name, supervision, viewer
    from us_sim.command.setting_options import read_settings
    from us_sim.errors import UsSimError
    from us_sim.run.fork_server import ForkServer

    parameters = node_parameters(args.param)
    if args.attach:
        asked = (args.scene, args.case, args.volume, args.path, args.tracker or None)
        if "record" in args or any(each is not None for each in asked):
            raise UsSimError(
                "--attach shows what runs already: leave out the scene, --case, --volume, --path, "
                "--record and --tracker, or leave out --attach"
            )
        from us_sim.run.live import view_running

        return view_running(
            viewer(args), parameters, network=args.network, supervision=supervision(args)
        )
    if args.loop and args.path is None:
        raise UsSimError("--loop plays a path again and again: name one with --path")
    with ForkServer() as forks:  # which imports what the nodes need while this process does
        from us_sim.run.live import run
        from us_sim.scene.reading import load_scene

        return run(
            load_scene(scene_name(args, "upper_arm"), volume=args.volume),
            parameters,
            record=read_settings(args, RunSettings, ("record",)).record,
            path=args.path,
            topic=args.topic,
            duration=None,
            network=args.network,
            supervision=supervision(args),
            view=viewer(args),
            by_hand=not args.tracker,
            playing={"stay": True, "loop": args.loop} if args.path is not None else None,
            forks=forks,
        )
