"""Options of the commands that use a scene."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from us_sim.command.setting_options import add_setting_options, read_settings
from us_sim.errors import UsSimError
from us_sim.run.supervision_settings import SupervisionSettings

__all__ = [
    "add_network_option",
    "add_scene_options",
    "add_supervision_options",
    "node_parameters",
    "scene_name",
    "supervision",
]


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
