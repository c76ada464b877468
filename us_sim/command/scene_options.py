"""Options of the commands that use a scene."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.errors import UsSimError
from us_sim.run.supervision_settings import SupervisionSettings
from us_sim.share import find_bag

if TYPE_CHECKING:
    from us_sim.settings.viewer import ViewerSettings

_OF_THE_VIEWER = ("host", "port", "recordings")


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """A case in place of a scene, another volume, and parameters of the scene's nodes."""
    parser.add_argument(
        "--case", metavar="NAME", help="case to make the scene from: its name or folder"
    )
    parser.add_argument(
        "--volume", type=Path, metavar="FILE", help="volume in place of the scene's"
    )
    parser.add_argument(
        "--param",
        action="append",
        default=[],
        metavar="NODE.NAME=VALUE",
        help="set a node's parameter; may be given again",
    )


def add_path_option(parser: argparse.ArgumentParser, what: str) -> None:
    """A probe path to play, and the body in it."""
    parser.add_argument("--path", type=find_bag, metavar="BAG", help=what)
    parser.add_argument(
        "--topic",
        metavar="NAME",
        help="of the path's poses, where the bag has several: a topic, TOPIC:NUMBER in a "
        "PoseArray, TOPIC:FRAME or TOPIC:FRAME:PARENT in tf, or a recording's transform",
    )


def scene_name(args: argparse.Namespace, default: str | None = None) -> str:
    """The scene that is asked for, or ``case:`` and the case.

    Raises:
        UsSimError: both are given, or neither and there is no default.
    """
    from us_sim.scene.scene import CASE_PREFIX

    if args.case is not None:
        if args.scene is not None:
            raise UsSimError(
                f"--case {args.case}: the scene {args.scene} is given too; keep one, or write "
                f"`case: {args.case}` into the scene"
            )
        return f"{CASE_PREFIX}{args.case}"
    name = args.scene or default
    if name is None:
        raise UsSimError("name a scene, or a case with --case; `us-sim cases` lists cases")
    return str(name)


def add_network_option(parser: argparse.ArgumentParser) -> None:
    """Whether other machines are talked to."""
    parser.add_argument("--network", action="store_true", help="talk beyond this host")


def add_supervision_options(parser: argparse.ArgumentParser) -> None:
    """When a node hangs, and how often one is started again."""
    add_setting_options(parser, SupervisionSettings)


def supervision(args: argparse.Namespace) -> SupervisionSettings:
    """What these options say.

    Raises:
        UsSimError: a value will not do.
    """
    return read_settings(args, SupervisionSettings)


def add_viewer_options(parser: argparse.ArgumentParser) -> None:
    """Where the page is served."""
    from us_sim.settings.viewer import ViewerSettings

    add_setting_options(parser, ViewerSettings, _OF_THE_VIEWER)


def add_view_option(parser: argparse.ArgumentParser) -> None:
    """Whether the simulation is shown in browsers, too."""
    parser.add_argument("--view", action="store_true", help="show it in a browser, too")
    add_viewer_options(parser)


def viewer(args: argparse.Namespace) -> ViewerSettings:
    """What these options say.

    Raises:
        UsSimError: a value will not do.
    """
    from us_sim.settings.viewer import ViewerSettings

    return read_settings(args, ViewerSettings, _OF_THE_VIEWER)


def viewed(args: argparse.Namespace) -> ViewerSettings | None:
    """Likewise, where the simulation is to be shown.

    Raises:
        UsSimError: a value will not do, or it is not to be shown at all.
    """
    if args.view:
        return viewer(args)
    if any(name in args for name in _OF_THE_VIEWER):
        raise UsSimError("--host, --port and --recordings are the viewer's: add --view")
    return None


def node_parameters(texts: Sequence[str]) -> dict[str, dict[str, str]]:
    """What ``--param`` sets: values by name, by node.

    Raises:
        UsSimError: a text is not written ``node.name=value``.
    """
    parameters: dict[str, dict[str, str]] = {}
    for text in texts:
        target, equals, value = text.partition("=")
        node, dot, name = target.partition(".")
        if not (equals and dot and node and name):
            raise UsSimError(
                f"--param {text}: write NODE.NAME=VALUE, e.g. tissue_deformer.solver=msds"
            )
        parameters.setdefault(node, {})[name] = value
    return parameters
