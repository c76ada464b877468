"""The command `us-sim`: each of its commands, and how errors reach a person."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from us_sim import __version__
from us_sim.command.calibrate import add_calibrate
from us_sim.command.print_marker import add_print_marker
from us_sim.command.reference import add_reference
from us_sim.errors import UsSimError
from us_sim.share import find_bag

__all__ = ["main"]


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; 0 when it did its work, 1 with a sentence for bad input, 130 on Ctrl-C."""
    parsed = _parser().parse_args(args)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    try:
        return int(parsed.command(parsed) or 0)
    except UsSimError as error:
        print(f"us-sim: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("us-sim: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"us-sim: {where}{error.strerror or error}", file=sys.stderr)
        return 1


def _interrupt(*_: object) -> None:
    """End as on Ctrl-C, so that no node outlives the command."""
    raise KeyboardInterrupt


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="us-sim", description="Interactive simulation of compression ultrasonography."
    )
    parser.add_argument("--version", action="version", version=f"us-sim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", help="press on the virtual arm; images, summary, recording")
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
    demo.add_argument(
        "--out",
        type=Path,
        default=Path("us_sim_demo"),
        help="folder to write to; default: %(default)s",
    )
    _scene_options(demo)
    _live_options(demo)
    demo.set_defaults(command=_demo)

    run = commands.add_parser("run", help="run the nodes of a scene until Ctrl-C")
    run.add_argument("scene", help="scene file, or name of an installed one")
    run.add_argument("--record", type=Path, metavar="FILE", help="record the session to this MCAP")
    run.add_argument("--duration", type=float, metavar="S", help="end after so many seconds")
    run.add_argument("--path", type=find_bag, metavar="BAG", help="play this bag's probe path")
    run.add_argument("--dry-run", action="store_true", help="say what would run, and why")
    _scene_options(run)
    _live_options(run)
    run.set_defaults(command=_run)

    render = commands.add_parser("render", help="one image for every pose of a path, repeatably")
    render.add_argument("scene", help="scene file, or name of an installed one")
    render.add_argument(
        "--path", type=find_bag, metavar="BAG", help="bag with the probe path; default: the scene's"
    )
    render.add_argument("--out", type=Path, required=True, help="folder to write to")
    _scene_options(render)
    render.set_defaults(command=_render)

    play = commands.add_parser("play", help="play a bag's probe path into a running simulation")
    play.add_argument("bag", type=find_bag, help="file or folder, or name of an installed one")
    play.add_argument("--topic", default="", help="PoseStamped topic, where the bag has several")
    play.add_argument("--rate", type=float, default=1.0, help="speed factor")
    play.add_argument("--loop", action="store_true", help="start again at the end")
    play.add_argument("--everything", action="store_true", help="publish every topic as recorded")
    play.add_argument("--network", action="store_true", help="talk beyond this host")
    play.set_defaults(command=_play)

    bag = commands.add_parser("bag", help="look at recordings")
    bag_commands = bag.add_subparsers(required=True, metavar="COMMAND")
    info = bag_commands.add_parser("info", help="topics, types, counts and times of a recording")
    info.add_argument("file", type=Path)
    info.set_defaults(command=_bag_info)

    add_calibrate(commands)
    add_print_marker(commands)
    add_reference(commands)

    evaluate = commands.add_parser("evaluate", help="measure: CSV, pictures and a report")
    subjects = evaluate.add_subparsers(required=True, metavar="tissue|stability|slice|tracking")
    for subject, text, command in (
        ("tissue", "error of every tissue solver against its run time", _evaluate_tissue),
        ("stability", "what every tissue solver does with extreme cases", _evaluate_stability),
        ("slice", "error of every slicing method against its run time", _evaluate_slice),
        ("tracking", "error of tracked poses against their run time", _evaluate_tracking),
    ):
        measured = subjects.add_parser(subject, help=text)
        minutes = "two" if subject in ("slice", "tracking") else "three"
        measured.add_argument(
            "--quick",
            action="store_true",
            help=f"a part of it, in less than {minutes} minutes",
        )
        measured.add_argument(
            "--out",
            type=Path,
            default=Path(f"us_sim_{subject}"),
            help="folder to write to; default: %(default)s",
        )
        measured.set_defaults(command=command)
        if subject == "slice":
            measured.add_argument(
                "--volume", type=Path, metavar="FILE", help="volume compounded from --sweep"
            )
            measured.add_argument(
                "--sweep", type=Path, metavar="FILE", help="tracked sweep to compare images with"
            )
    return parser


def _scene_options(parser: argparse.ArgumentParser) -> None:
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


def _live_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--network", action="store_true", help="talk beyond this host")


def _demo(args: argparse.Namespace) -> int:
    from us_sim.run.live import demo

    return demo(
        args.scene or ("upper_arm_camera" if args.source == "camera" else "upper_arm"),
        args.volume,
        args.out,
        _parameters(args.param),
        network=args.network,
        source=args.source,
    )


def _run(args: argparse.Namespace) -> int:
    from us_sim.run.live import dry_run, run
    from us_sim.scene.reading import load_scene

    if args.duration is not None and not args.duration > 0:
        raise UsSimError(f"--duration {args.duration:g}: must be more than 0 seconds")
    if args.record is not None and args.record.suffix != ".mcap":
        raise UsSimError(f"--record {args.record}: must be a file that ends in .mcap")
    if args.record is not None and args.record.exists():
        raise UsSimError(f"--record {args.record}: exists already; choose another name")
    scene = load_scene(args.scene, volume=args.volume)
    parameters = _parameters(args.param)
    if args.dry_run:
        from us_sim.scene.readable_files import check_files

        checked = check_files(scene)
        print(dry_run(scene, parameters, record=args.record, path=args.path))
        if checked:
            print(f"readable  {', '.join(checked)}")
        return 0
    return run(
        scene,
        parameters,
        record=args.record,
        path=args.path,
        duration=args.duration,
        network=args.network,
    )


def _render(args: argparse.Namespace) -> int:
    from us_sim.run.lockstep import render_scene
    from us_sim.scene.reading import load_scene

    scene = load_scene(args.scene, volume=args.volume)
    return render_scene(scene, args.path, args.out, _parameters(args.param))


def _play(args: argparse.Namespace) -> int:
    from us_sim.run.live import play

    if not 0.01 <= args.rate <= 100:
        raise UsSimError(f"--rate {args.rate:g}: must be from 0.01 to 100")
    return play(
        args.bag,
        topic=args.topic,
        rate=args.rate,
        loop=args.loop,
        everything=args.everything,
        network=args.network,
    )


def _bag_info(args: argparse.Namespace) -> int:
    from us_sim.recording.reader import read_bag
    from us_sim.recording.report import describe

    print(describe(read_bag(args.file)))
    return 0


def _evaluate_tissue(args: argparse.Namespace) -> int:
    from us_sim.evaluation.tissue.measure import evaluate_tissue

    return evaluate_tissue(args.out, args.quick)


def _evaluate_stability(args: argparse.Namespace) -> int:
    from us_sim.evaluation.stability.measure import evaluate_stability

    return evaluate_stability(args.out, args.quick)


def _evaluate_slice(args: argparse.Namespace) -> int:
    from us_sim.evaluation.slice.measure import evaluate_slice

    return evaluate_slice(args.out, args.quick, args.volume, args.sweep)


def _evaluate_tracking(args: argparse.Namespace) -> int:
    from us_sim.evaluation.tracking.measure import evaluate_tracking

    return evaluate_tracking(args.out, args.quick)


def _parameters(texts: Sequence[str]) -> dict[str, dict[str, str]]:
    """``node.name=value`` texts by node."""
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
