"""The command `us-sim play`."""

from __future__ import annotations

import argparse
from typing import Any

from us_sim.command.scene_options import add_network_option
from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.share import find_bag

_OF_THE_PLAYER = ("rate", "loop")


def add_play(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "play", help="play a bag's probe path into a running simulation", add_options=_add_options
    )


def _add_options(parser: argparse.ArgumentParser) -> None:
    from us_sim.nodes.settings import SessionPlayerSettings

    parser.add_argument("bag", type=find_bag, help="file or folder, or name of an installed one")
    parser.add_argument("--topic", default="", help="PoseStamped topic, where the bag has several")
    add_setting_options(parser, SessionPlayerSettings, _OF_THE_PLAYER)
    parser.add_argument("--everything", action="store_true", help="publish every topic as recorded")
    add_network_option(parser)
    parser.set_defaults(command=_play)


def _play(args: argparse.Namespace) -> int:
    from us_sim.nodes.settings import SessionPlayerSettings
    from us_sim.run.live import play

    player = read_settings(args, SessionPlayerSettings, _OF_THE_PLAYER)
    return play(
        args.bag,
        topic=args.topic,
        rate=player.rate,
        loop=player.loop,
        everything=args.everything,
        network=args.network,
    )
