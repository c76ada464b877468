"""The command `us-sim demo`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from us_sim.command.scene_options import (
    add_network_option,
    add_path_option,
    add_scene_options,
    add_supervision_options,
    add_view_option,
    node_parameters,
    scene_name,
    supervision,
    viewed,
)


def add_demo(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    commands.add_parser(
        "demo",
        help="press on the virtual arm; images, summary, recording",
        add_options=_add_options,
    )


def _add_options(demo: argparse.ArgumentParser) -> None:
    demo.add_argument(
        "scene",
        nargs="?",
        help="scene file or name; default: upper_arm, or upper_arm_camera with --source camera",
    )
    demo.add_argument(
        "--source",
        choices=("path", "camera"),
        help="poses as they were recorded, or tracked in a camera video that is rendered of them; "
        "default: camera where the scene's tracker is one",
    )
    add_path_option(
        demo, "play this probe path, such as hand.mcap, a brisk hand; default: the scene's own"
    )
    demo.add_argument(
        "--out",
        type=Path,
        default=Path("us_sim_demo"),
        help="folder to write to; default: %(default)s",
    )
    add_scene_options(demo)
    add_supervision_options(demo)
    add_view_option(demo)
    add_network_option(demo)
    demo.set_defaults(command=_demo)


def _demo(args: argparse.Namespace) -> int:
    from us_sim.run.fork_server import ForkServer

    with ForkServer() as forks:  # which imports what the nodes need while this process does
        from us_sim.run.live import demo

        return demo(
            scene_name(args, "upper_arm_camera" if args.source == "camera" else "upper_arm"),
            args.volume,
            args.out,
            node_parameters(args.param),
            network=args.network,
            supervision=supervision(args),
            source=args.source,
            path=args.path,
            topic=args.topic,
            view=viewed(args),
            forks=forks,
        )
