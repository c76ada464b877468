"""The command `us-sim bag`: list, check, compare, extract, repair and convert recordings."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from us_sim.errors import UsSimError

_EXTRACTED = {
    "poses": "poses of each topic as CSV",
    "wrench": "forces and torques of each topic as CSV",
    "images": "images of each topic as PNG, with their scale",
    "areas": "areas of vessels in the image plane as CSV",
}


def bag_options(bag: argparse.ArgumentParser) -> None:
    bag_commands = bag.add_subparsers(required=True, metavar="COMMAND")
    info = bag_commands.add_parser("info", help="topics, types, counts and times of a recording")
    info.add_argument("file", type=Path)
    info.set_defaults(command=_info)
    check = bag_commands.add_parser(
        "check", help="whether a recording is whole: index, order, gaps, latency, losses, stamps"
    )
    check.add_argument("file", type=Path, metavar="SESSION")
    check.set_defaults(command=_check)
    diff = bag_commands.add_parser(
        "diff", help="how far two recordings of the same poses are apart; status 0 if they are not"
    )
    diff.add_argument("one", type=Path, metavar="A")
    diff.add_argument("other", type=Path, metavar="B")
    diff.add_argument("--out", type=Path, help="folder for the numbers as CSV")
    diff.set_defaults(command=_diff)
    extract = bag_commands.add_parser(
        "extract",
        help="write the files attached to a recording, such as its scene; or, with options, its "
        "poses, wrenches, images and areas",
    )
    extract.add_argument("file", type=Path)
    extract.add_argument("--out", type=Path, required=True, help="folder to write to")
    for name, text in _EXTRACTED.items():
        extract.add_argument(f"--{name}", action="store_true", help=text)
    extract.set_defaults(command=_extract)
    repair = bag_commands.add_parser(
        "repair", help="all that can be read of a damaged or cut recording, as a new one"
    )
    repair.add_argument("file", type=Path)
    repair.add_argument(
        "--out", type=Path, help="new folder or .mcap file (default: FILE_repaired beside it)"
    )
    repair.set_defaults(command=_repair)
    lerobot = bag_commands.add_parser(
        "to-lerobot", help="sessions as the episodes of a LeRobot data set, resampled to one rate"
    )
    lerobot.add_argument("files", type=Path, nargs="+", metavar="SESSION")
    lerobot.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to make")
    lerobot.add_argument(
        "--rate", type=int, metavar="HZ", help="frames a second (default: that of the images)"
    )
    lerobot.add_argument(
        "--topics",
        nargs="+",
        default=[],
        metavar="NAME",
        help="topics, or bodies such as /tf:probe (default: all images, poses, wrenches, twists "
        "and joint states)",
    )
    lerobot.add_argument("--action", metavar="NAME", help="topic or body that is the action")
    lerobot.add_argument(
        "--task", default="Scan the patient.", metavar="TEXT", help="in words: %(default)s"
    )
    lerobot.add_argument(
        "--by-log-time", action="store_true", help="go by when messages were recorded, not stamped"
    )
    lerobot.add_argument("--video", action="store_true", help="images as MP4, not as PNG")
    lerobot.set_defaults(command=_to_lerobot)


def _info(args: argparse.Namespace) -> int:
    from us_sim.recording.reader import describe, read_bag

    print(describe(read_bag(args.file)))
    return 0


def _check(args: argparse.Namespace) -> int:
    from us_sim.progress import late_progress
    from us_sim.recording.reader import read_bag
    from us_sim.run.session_check import check, report

    found = check(read_bag(args.file), late_progress(f"bag check {args.file.name}"))
    print(report(found))
    return int(bool(found.findings))


def _diff(args: argparse.Namespace) -> int:
    """As diff: 0 if they are equal, 1 if they differ, 2 if they cannot be compared."""
    from us_sim.progress import end_late_bars, late_progress
    from us_sim.recording.reader import read_bag
    from us_sim.run.session_diff import diff, table, write

    try:
        found = diff(read_bag(args.one), read_bag(args.other), late_progress("bag diff"))
        print(table(found))
        if args.out is not None:
            print(write(found, args.out))
    except UsSimError as error:
        end_late_bars()
        print(f"us-sim: {error}", file=sys.stderr)
        return 2
    return int(not found.is_none)


def _extract(args: argparse.Namespace) -> int:
    from us_sim.recording.repair import extract

    asked = [name for name in _EXTRACTED if vars(args)[name]]
    if not asked:
        for file in extract(args.file, args.out):
            print(file)
        return 0
    from us_sim.progress import late_progress
    from us_sim.recording.reader import read_bag
    from us_sim.run.session_extract import write_parts

    show = late_progress(f"bag extract {args.file.name}")
    for line in write_parts(read_bag(args.file), args.out, asked, show):
        print(line)
    return 0


def _repair(args: argparse.Namespace) -> int:
    from us_sim.recording.repair import repair
    from us_sim.settings.spelling import counted

    file: Path = args.file
    made = repair(file, args.out or file.with_name(f"{file.stem}_repaired"))
    for fault in made.faults:
        print(fault.text)
    print(f"{counted(made.message_count, 'message is', 'messages are')} in {made.path}")
    return 0


def _to_lerobot(args: argparse.Namespace) -> int:
    from us_sim.progress import late_progress
    from us_sim.run.session_lerobot import to_lerobot

    told = to_lerobot(
        args.files,
        args.out,
        args.task,
        late_progress("bag to-lerobot"),
        rate=args.rate,
        is_video=args.video,
        topics=args.topics,
        action=args.action,
        by_log_time=args.by_log_time,
    )
    print("\n".join(told))
    return 0
