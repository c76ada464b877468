"""Options of commands: from settings, and those of every command that takes a scene.

A field of settings without a default becomes a positional argument, or a required option if it is
keyword-only. A field with a default becomes an option, or a flag if it is a bool.

>>> import argparse
>>> from us_sim.command.calibration_settings import ClockCalibrationSettings
>>> parser = argparse.ArgumentParser()
>>> add_setting_options(parser, ClockCalibrationSettings)
>>> args = parser.parse_args(["a.mcap", "b.mcap", "--largest", "2 min"])
>>> read_settings(args, ClockCalibrationSettings)
Traceback (most recent call last):
...
us_sim.errors.CalibrationError: --largest: '2 min' is not a time in s, ms, us or µs
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from us_sim.errors import UsSimError
from us_sim.settings.setting import Settings, kinds_of, rules_of
from us_sim.settings.spelling import describe_unknown
from us_sim.settings.viewer import ViewerSettings
from us_sim.share import find_bag


class ChosenParser(argparse.ArgumentParser):
    """A parser to which ``add_options`` adds the options at its first use."""

    def __init__(
        self,
        *args: Any,
        add_options: Callable[[argparse.ArgumentParser], None] | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(*args, **settings)
        self._add_options = add_options

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Add the options and parse; refuse an unknown option with the closest known one."""
        add_options, self._add_options = self._add_options, None
        if add_options is not None:
            add_options(self)
        parsed, others = super().parse_known_args(args, namespace)
        for other in others:
            if other.startswith("--"):
                self.error(describe_unknown(other.partition("=")[0], self._option_string_actions))
        return parsed, others

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, describe_unknown(value, map(str, action.choices)))


S = TypeVar("S", bound=Settings)


def add_setting_options(
    parser: argparse.ArgumentParser, settings: type[Settings], only: Iterable[str] = ()
) -> None:
    """Add an option for each setting, or only for the named ones."""
    wanted = set(only) or set(rules_of(settings))
    for field in dataclasses.fields(settings):
        if field.name in wanted:
            _add_option(parser, settings, field)


def read_settings(
    args: argparse.Namespace, settings: type[S], only: Iterable[str] = (), **values: Any
) -> S:
    """Read settings from parsed options.

    Args:
        args: of a parser that `add_setting_options` has filled.
        settings: class of the settings.
        only: as for `add_setting_options`.
        **values: of fields that are no options.

    Raises:
        UsSimError: an option's value is wrong; the class is the settings' own.
    """
    for name in set(only) or set(rules_of(settings)):
        if name in args:
            values[name] = getattr(args, name)
    try:
        return settings(**values)
    except UsSimError as error:
        if error.key:
            option = error.key.split("[")[0].replace("_", "-")
            raise type(error)(f"--{option}: {error.problem}") from error
        raise


def _add_option(
    parser: argparse.ArgumentParser, settings: type[Settings], field: dataclasses.Field[Any]
) -> None:
    rule, kind = rules_of(settings)[field.name], kinds_of(settings)[field.name]
    option = f"--{field.name.replace('_', '-')}"
    if kind is bool:
        parser.add_argument(option, action="store_true", help=rule.description)
        return
    if get_origin(kind) is not tuple:  # a type, or one that may be None
        kind = next((part for part in get_args(kind) if part is not type(None)), kind)
    unit = rule.quantity.unit if rule.quantity else ""
    names = ", ".join(rule.choice.names if rule.choice else rule.choices)
    more: dict[str, Any] = {"type": Path} if kind is Path else {}
    more["help"] = rule.description + (names and f": {names}")
    if get_origin(kind) is tuple:
        more["nargs"] = "+" if Ellipsis in get_args(kind) else len(get_args(kind))
    required = field.default is dataclasses.MISSING
    if required and not field.kw_only:
        parser.add_argument(field.name, **more)
        return
    if not required:
        more["default"] = argparse.SUPPRESS
        more["help"] += f"; default: {field.default} {unit}".rstrip() if field.default else ""
    metavar = unit.upper() or ("FILE" if kind is Path else "N" if rule.quantity else "NAME")
    parser.add_argument(option, metavar=metavar, required=required, **more)


_OF_THE_VIEWER = ("host", "port", "recordings")


def add_scene_options(parser: argparse.ArgumentParser, default: str = "") -> None:
    """Add the options of a scene, a case in place of it, and another volume."""
    parser.add_argument(
        "scene", nargs="?", help=f"scene file, or name of an installed one{default}"
    )
    parser.add_argument(
        "--case", metavar="NAME", help="case to make the scene from: its name or folder"
    )
    parser.add_argument(
        "--volume", type=Path, metavar="FILE", help="volume in place of the scene's"
    )


def add_parameter_option(parser: argparse.ArgumentParser) -> None:
    """Add the option of parameters of the scene's nodes."""
    parser.add_argument(
        "--param",
        action="append",
        default=[],
        metavar="NODE.NAME=VALUE",
        help="set a node's parameter; may be given again",
    )


def add_path_option(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the options of a probe path to play, and the body in it."""
    parser.add_argument("--path", type=find_bag, metavar="BAG", help=what)
    parser.add_argument(
        "--topic",
        metavar="NAME",
        help="of the path's poses, where the bag has several: a topic, TOPIC:NUMBER in a "
        "PoseArray, TOPIC:FRAME or TOPIC:FRAME:PARENT in tf, or a recording's transform",
    )


def read_scene_name(args: argparse.Namespace, default: str | None = None) -> str:
    """Return the name of the scene, or ``case:`` and the name of the case.

    Raises:
        UsSimError: both are given, or neither without a default.
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
    """Add the option to talk to other machines, and ROS's own arguments."""
    parser.add_argument("--network", action="store_true", help="talk beyond this host")
    parser.add_argument(  # `us_sim.command.main` has taken them, up to a `--`
        "--ros-args",
        nargs=argparse.REMAINDER,
        help="for all nodes, as of `ros2 run`: -r __ns:=/left, -r FROM:=TO, -p NAME:=VALUE",
    )


def add_running_options(parser: argparse.ArgumentParser, default: str = "") -> None:
    """Add the options of a scene, of the supervision of its nodes, and of the network."""
    from us_sim.run.supervision import SupervisionSettings

    add_scene_options(parser, default)
    add_parameter_option(parser)
    add_setting_options(parser, SupervisionSettings)
    add_network_option(parser)


def add_viewer_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the viewer's server."""
    add_setting_options(parser, ViewerSettings, _OF_THE_VIEWER)


def add_view_option(parser: argparse.ArgumentParser) -> None:
    """Add the option to show the simulation in a browser, too, and those of the server."""
    parser.add_argument("--view", action="store_true", help="show it in a browser, too")
    add_viewer_options(parser)


def read_viewer_settings(args: argparse.Namespace) -> ViewerSettings:
    """Read the settings of the viewer; raise UsSimError for a wrong value."""
    return read_settings(args, ViewerSettings, _OF_THE_VIEWER)


def read_view_settings(args: argparse.Namespace) -> ViewerSettings | None:
    """Read the settings of the viewer; None without ``--view``.

    Raises:
        UsSimError: a value is wrong, or given without ``--view``.
    """
    if args.view:
        return read_viewer_settings(args)
    if any(name in args for name in _OF_THE_VIEWER):
        raise UsSimError("--host, --port and --recordings are the viewer's: add --view")
    return None


def read_node_parameters(texts: Sequence[str]) -> dict[str, dict[str, str]]:
    """Read the values of ``--param``, by node and name.

    Raises:
        UsSimError: a text is not ``node.name=value``.
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


def read_scene_keys(texts: Sequence[str]) -> dict[str, Any]:
    """Read the values of ``--set`` as nested keys of a scene.

    >>> read_scene_keys(["tissue.solver=fem", "episode.steps=100", "episode.draws={gain: [0, 0]}"])
    {'tissue': {'solver': 'fem'}, 'episode': {'steps': 100, 'draws': {'gain': [0, 0]}}}

    Raises:
        UsSimError: a text is not ``key.key=value``.
    """
    import yaml

    keys: dict[str, Any] = {}
    for text in texts:
        inner = keys
        try:
            key, value = text.split("=", 1)
            *above, last = key.split(".")
            for name in above:
                inner = inner.setdefault(name, {})
            inner[last] = yaml.safe_load(value)
        except (AttributeError, TypeError, ValueError, yaml.YAMLError) as error:
            raise UsSimError(f"--set {text}: write KEY=VALUE, as tissue.solver=fem") from error
    return keys
