"""The command `us-sim render`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from us_sim.command.scene_options import (
    add_path_option,
    add_scene_options,
    node_parameters,
    scene_name,
)


def add_render(commands: Any) -> None:
    """Add the command to `us-sim`'s."""
    render = commands.add_parser("render", help="one image for every pose of a path, repeatably")
    render.add_argument("scene", nargs="?", help="scene file, or name of an installed one")
    add_path_option(render, "bag with the probe path; default: the scene's")
    render.add_argument("--out", type=Path, required=True, help="folder to write to")
    render.add_argument(
        "--truth",
        action="store_true",
        help="beside each image what is known of it: labels (PNG) and displacement (NumPy's .npy)",
    )
    add_scene_options(render)
    render.set_defaults(command=_render)


def _render(args: argparse.Namespace) -> int:
    from us_sim.run.lockstep import render_scene
    from us_sim.scene.reading import load_scene

    scene = load_scene(scene_name(args), volume=args.volume)
    parameters = node_parameters(args.param)
    return render_scene(scene, args.path, args.out, parameters, topic=args.topic, truth=args.truth)
