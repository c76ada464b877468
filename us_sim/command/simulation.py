"""The commands that simulate: `demo`, `run`, `render`, `view`, `play`."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from us_sim.command.options import (
    add_network_option,
    add_parameter_option,
    add_path_option,
    add_running_options,
    add_scene_options,
    add_setting_options,
    add_view_option,
    add_viewer_options,
    read_node_parameters,
    read_scene_name,
    read_settings,
    read_view_settings,
    read_viewer_settings,
)
from us_sim.errors import UsSimError
from us_sim.run.processes import begin_fork_server, prepare_ros
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.share import find_bag, full_path

if TYPE_CHECKING:
    from us_sim.run.plan import RunRequest
    from us_sim.run.supervision import SupervisionSettings


def demo_options(demo: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim demo`."""
    add_path_option(
        demo, "play this probe path, such as hand.mcap, a brisk hand; default: the scene's own"
    )
    demo.add_argument(
        "--out",
        type=Path,
        default=Path("us_sim_demo"),
        help="folder to write to; default: %(default)s",
    )
    add_running_options(demo, "; default: upper_arm")
    add_view_option(demo)
    demo.set_defaults(command=_demo)


def _demo(args: argparse.Namespace) -> int:
    begin_fork_server()
    from us_sim.run.live import run_demo

    request = _make_request(args, "upper_arm", view=read_view_settings(args))
    prepare_ros(network=args.network)
    return run_demo(request, args.out, _read_supervision(args))


def _make_request(args: argparse.Namespace, default: str | None = None, **more: Any) -> RunRequest:
    """Load the scene of the options; return the request to run it, with ``more`` of its fields."""
    parameters = read_node_parameters(args.param)
    from us_sim.run.plan import RunRequest
    from us_sim.scene.reading import load_scene

    scene = load_scene(read_scene_name(args, default), volume=args.volume)
    return RunRequest(scene, parameters, path=args.path, topic=args.topic, **more)


def _read_supervision(args: argparse.Namespace) -> SupervisionSettings:
    from us_sim.run.supervision import SupervisionSettings

    return read_settings(args, SupervisionSettings)


@dataclass(frozen=True)
class RunSettings(Settings):
    """The recording and the end of a run."""

    record: Path | None = setting(description="record the session to this MCAP", default=None)
    duration: float | None = setting(Quantity("time", 1e-3, 1e7), "end after so long", default=None)


def run_options(run: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim run`."""
    add_setting_options(run, RunSettings)
    add_path_option(run, "play this bag's probe path")
    run.add_argument("--dry-run", action="store_true", help="say what would run, and why")
    add_running_options(run)
    add_view_option(run)
    run.set_defaults(command=_run)


def _run(args: argparse.Namespace) -> int:
    asked = read_settings(args, RunSettings)
    if not args.dry_run:
        begin_fork_server()
    from us_sim.run.live import dry_run, run_scene
    from us_sim.scene.reading import check_files

    request = _make_request(
        args, record=asked.record, duration=asked.duration, view=read_view_settings(args)
    )
    if not args.dry_run:
        prepare_ros(network=args.network)
        return run_scene(request, _read_supervision(args))
    scene = request.scene
    checked = check_files(scene)
    path = args.path or (Path(scene.path) if scene.path else None)
    if path is not None and not scene.volume.phantom:
        from us_sim.scene.building import load_volume
        from us_sim.scene.placement import check_path_in_volume

        check_path_in_volume(scene, path, load_volume(scene), args.topic if args.path else None)
    print(dry_run(request))
    if checked:
        print(f"readable  {', '.join(checked)}")
    return 0


def render_options(render: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim render`."""
    add_path_option(render, "bag with the probe path; default: the scene's")
    render.add_argument("--out", type=Path, required=True, help="folder to write to")
    render.add_argument(
        "--truth",
        action="store_true",
        help="beside each image what is known of it: labels (PNG) and displacement (NumPy's .npy)",
    )
    add_scene_options(render)
    add_parameter_option(render)
    render.set_defaults(command=_render)


def _render(args: argparse.Namespace) -> int:
    from us_sim.run.lockstep import render_scene

    return render_scene(_make_request(args), args.out, truth=args.truth)


def view_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim view`."""
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
    parser.add_argument("--student", default="", help="name that results of exercises bear")
    parser.add_argument(
        "--results",
        metavar="ADDRESS",
        help="folder, or address of fsspec, to which the result of each attempt is written",
    )
    parser.add_argument(
        "--attach", action="store_true", help="show a simulation that runs already, anywhere"
    )
    add_running_options(parser, "; default: upper_arm")
    parser.set_defaults(command=_view)


def _view(args: argparse.Namespace) -> int:
    supervision = _read_supervision(args)
    if not args.attach:
        begin_fork_server()
    from us_sim.run.live import run_scene, view_running

    if args.attach:
        given = ("scene", "case", "volume", "path", "tracker", "record")
        if any(getattr(args, name, None) for name in given):
            raise UsSimError(
                "--attach shows what runs already: leave out the scene, --case, --volume, --path, "
                "--record and --tracker, or leave out --attach"
            )
        parameters = read_node_parameters(args.param)
        prepare_ros(network=args.network)
        return view_running(read_viewer_settings(args), parameters, supervision)
    if args.loop and args.path is None:
        raise UsSimError("--loop plays a path again and again: name one with --path")
    request = _make_request(
        args,
        "upper_arm",
        record=read_settings(args, RunSettings, ("record",)).record,
        view=read_viewer_settings(args),
        by_hand=not args.tracker,
        student=args.student,
        results=_read_results_address(args),
        playing={"stay": True, "loop": args.loop} if args.path is not None else {},
    )
    prepare_ros(network=args.network)
    return run_scene(request, supervision)


def _read_results_address(args: argparse.Namespace) -> str | None:
    """Return the address of the results; a folder's is absolute, for nodes run anywhere.

    Raises:
        UsSimError: a student is given without an address, or the address cannot be written to.
    """
    from us_sim.scoring.result_place import ResultPlace

    if args.results is None:
        if args.student:
            raise UsSimError(f"--student {args.student}: say with --results where results go")
        return None
    address = str(args.results if "://" in args.results else full_path(args.results))
    ResultPlace(address).try_out()
    return address


_OF_THE_PLAYER = ("rate", "loop", "time")


def play_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `us-sim play`."""
    from us_sim.nodes.settings import PlayerSettings

    parser.add_argument("bag", type=find_bag, help="file or folder, or name of an installed one")
    parser.add_argument("--topic", default="", help="of the poses, where the bag has several")
    add_setting_options(parser, PlayerSettings, _OF_THE_PLAYER)
    parser.add_argument(
        "--clock",
        nargs="?",
        const="40",
        default="0",
        metavar="HZ",
        help="publish the recording's time on /clock, 40 times a second or so often",
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--everything", action="store_true", help="publish every topic as recorded")
    what.add_argument(
        "--lockstep", action="store_true", help="send each pose when the last one's image is there"
    )
    add_network_option(parser)
    parser.set_defaults(command=_play)


def _play(args: argparse.Namespace) -> int:
    from us_sim.nodes.settings import PlayerSettings
    from us_sim.run.live import play_bag

    player = read_settings(args, PlayerSettings, (*_OF_THE_PLAYER, "clock"))
    prepare_ros(network=args.network)
    return play_bag(
        args.bag, player, topic=args.topic, everything=args.everything, lockstep=args.lockstep
    )
