"""The command `us-sim bag`: list, check, extract and convert recordings."""

from __future__ import annotations

import argparse
from pathlib import Path

_EXTRACTED = {
    "poses": "poses of each topic as CSV",
    "wrench": "forces and torques of each topic as CSV",
    "images": "images of each topic as PNG, with their scale",
    "areas": "areas of vessels in the image plane as CSV",
}


def bag_options(bag: argparse.ArgumentParser) -> None:
    """Add the subcommands of `us-sim bag`."""
    bag_commands = bag.add_subparsers(required=True, metavar="COMMAND")
    info = bag_commands.add_parser("info", help="topics, types, counts and times of a recording")
    info.add_argument("file", type=Path)
    info.set_defaults(command=_info)
    check = bag_commands.add_parser(
        "check", help="whether a recording is whole: index, order, gaps, latency, losses, stamps"
    )
    check.add_argument("file", type=Path, metavar="SESSION")
    check.set_defaults(command=_check)
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
    from us_sim.recording.reader import describe_bag, read_bag

    print(describe_bag(read_bag(args.file)))
    return 0


def _check(args: argparse.Namespace) -> int:
    from us_sim.errors import printable_line
    from us_sim.progress import late_progress
    from us_sim.recording.reader import read_bag
    from us_sim.run.session_check import check_bag
    from us_sim.settings.spelling import align_columns

    found = check_bag(read_bag(args.file), late_progress(f"bag check {args.file.name}"))
    size = sum(int(each.messages["size"].sum()) for each in found.topics) / 1e6
    head = f"{found.bag.path}: {found.bag.message_count} messages, {size:.1f} MB"
    told = [f"{each.kind}: {each.text}" for each in found.findings]
    for line in (head, "", *align_columns(found.rows), "", *(told or ["nothing is wrong with it"])):
        print(printable_line(line))
    return int(bool(found.findings))


def _extract(args: argparse.Namespace) -> int:
    from us_sim.recording.attached_files import extract_files

    asked = [name for name in _EXTRACTED if vars(args)[name]]
    if not asked:
        for file in extract_files(args.file, args.out):
            print(file)
        return 0
    from us_sim.progress import late_progress
    from us_sim.recording.reader import read_bag
    from us_sim.run.session_extract import write_parts

    show = late_progress(f"bag extract {args.file.name}")
    for line in write_parts(read_bag(args.file), args.out, asked, show):
        print(line)
    return 0


def _to_lerobot(args: argparse.Namespace) -> int:
    from us_sim.progress import late_progress
    from us_sim.run.session_lerobot import convert_sessions

    lines = convert_sessions(
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
    print("\n".join(lines))
    return 0
