"""The command `us-sim calibrate`: camera, pivot, landmarks, probe, time."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from us_sim.errors import CalibrationError
from us_sim.settings.quantity import Quantity

__all__ = ["add_calibrate"]

_LENGTH = Quantity("length")
_TIME = Quantity("time", 0.01, 60.0)


def add_calibrate(commands: Any) -> None:
    """Add the command and its five kinds to `us-sim`'s."""
    calibrate = commands.add_parser("calibrate", help="find out where trackers and tools are")
    kinds = calibrate.add_subparsers(required=True, metavar="camera|pivot|landmarks|probe|time")
    _add_camera(kinds)
    _add_pivot(kinds)
    _add_landmarks(kinds)
    _add_probe(kinds)
    _add_time(kinds)


def _add_camera(kinds: Any) -> None:
    parser = kinds.add_parser("camera", help="lens and focal length from photos of a board")
    parser.add_argument(
        "photos", nargs="+", help="files, folders or patterns such as 'shots/*.jpg'"
    )
    parser.add_argument(
        "--board", default="charuco", help="charuco (default), grid of markers, or chessboard"
    )
    parser.add_argument(
        "--size", required=True, metavar="CxR", help="squares or markers across and down: 5x7"
    )
    for name, what in (
        ("square", "side of a square"),
        ("marker", "side of a marker"),
        ("separation", "between the markers of a grid"),
    ):
        parser.add_argument(
            f"--{name}", type=_quantity(_LENGTH), default=0.0, metavar="M", help=f"{what}: '40 mm'"
        )
    parser.add_argument("--dictionary", help="of the markers, where there are; default: 4X4_50")
    parser.add_argument(
        "--legacy", action="store_true", help="the ChArUco board is as OpenCV before 4.6 drew it"
    )
    parser.add_argument("--name", default="camera", help="the camera's name in the file")
    _add_out(parser, "camera.yaml", "camera info; a picture of the coverage beside it")
    parser.set_defaults(command=_camera)


def _add_pivot(kinds: Any) -> None:
    parser = kinds.add_parser("pivot", help="a stylus' tip from turning it about the tip")
    parser.add_argument("recording", type=Path, help="bag, or tracker recording of Plus")
    _add_pose(parser)
    _add_out(parser, "tip.yaml", "the tip in the stylus' frame")
    parser.set_defaults(command=_pivot)


def _add_landmarks(kinds: Any) -> None:
    parser = kinds.add_parser(
        "landmarks", help="where the tracker or the probe is, from points touched"
    )
    parser.add_argument(
        "known", type=Path, help="landmarks in the patient's frame: CSV name,x,y,z or Plus' XML"
    )
    parser.add_argument(
        "measured",
        type=Path,
        help="the same as the tracker measured them: CSV, or a recording of the stylus",
    )
    parser.add_argument("--tip", type=Path, metavar="FILE", help="the stylus' tip, of a recording")
    parser.add_argument("--to", default="patient", help="frame of the known ones (%(default)s)")
    parser.add_argument(
        "--invert",
        action="store_true",
        help="the known frame in the measured one: a calibration, from points of the probe's face "
        "(--to probe) measured in its marker's frame",
    )
    _add_pose(parser)
    _add_out(parser, "registration.yaml", "the registration")
    parser.set_defaults(command=_landmarks)


def _add_probe(kinds: Any) -> None:
    parser = kinds.add_parser("probe", help="where the image lies on the probe, from a phantom")
    parser.add_argument(
        "sightings",
        type=Path,
        help="CSV: feature,column,row,x,y,z,qx,qy,qz,qw with the body's poses, or "
        "feature,column,row,time with --recording",
    )
    parser.add_argument(
        "--phantom",
        type=Path,
        metavar="FILE",
        help="CSV name,x,y,z of points or name,x1,y1,z1,x2,y2,z2 of wires, or Plus' XML; without "
        "it features are points at unknown places",
    )
    parser.add_argument("--recording", type=Path, metavar="FILE", help="the body's poses over time")
    parser.add_argument(
        "--registration", type=Path, metavar="FILE", help="from the poses' frame to the phantom's"
    )
    parser.add_argument(
        "--origin",
        nargs=2,
        type=float,
        required=True,
        metavar=("COLUMN", "ROW"),
        help="pixel at the middle of the transducer's face",
    )
    parser.add_argument(
        "--pixel",
        nargs=2,
        type=_quantity(_LENGTH),
        metavar=("WIDTH", "HEIGHT"),
        help="size of a pixel, where known: '0.2 mm' '0.2 mm'",
    )
    _add_pose(parser)
    _add_out(parser, "calibration.yaml", "the calibration")
    parser.set_defaults(command=_probe)


def _add_time(kinds: Any) -> None:
    parser = kinds.add_parser("time", help="offset of a tracker's clock from one motion")
    parser.add_argument("moving", type=Path, help="recording whose stamps are to be mended")
    parser.add_argument(
        "fixed", type=Path, help="recording whose stamps are right: poses or images"
    )
    parser.add_argument(
        "--largest",
        type=_quantity(_TIME),
        default=0.5,
        metavar="S",
        help="largest offset to believe (%(default)s s)",
    )
    parser.add_argument(
        "--images", action="store_true", help="the fixed recording's images, though it has poses"
    )
    _add_pose(parser)
    parser.add_argument(
        "--fixed-pose", metavar="NAME", help="the same of the fixed recording, where it differs"
    )
    _add_out(parser, "time.yaml", "the offset; a picture of both signals beside it")
    parser.set_defaults(command=_time)


def _add_pose(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--pose",
        metavar="NAME",
        help="topic of a bag, or transform of Plus such as StylusToReference; may be left out "
        "where there is one",
    )


def _add_out(parser: argparse.ArgumentParser, default: str, what: str) -> None:
    parser.add_argument(
        "--out", type=Path, default=Path(default), help=f"file to write: {what} (%(default)s)"
    )


def _quantity(quantity: Quantity) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            return quantity.parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return parse


def _camera(args: argparse.Namespace) -> int:
    from us_sim.progress import late_progress
    from us_sim.tracking.calibration.board import Board
    from us_sim.tracking.calibration.camera_command import calibrate_photos

    columns, _, rows = args.size.lower().partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise CalibrationError(f"--size {args.size}: write the board's size as 5x7")
    board = Board(
        args.board,
        int(columns),
        int(rows),
        args.square,
        args.marker,
        args.separation,
        args.dictionary or ("" if args.board == "chessboard" else "4X4_50"),
        args.legacy,
    )
    progress = late_progress("looking for the board")
    print(calibrate_photos(args.photos, board, _new(args.out), args.name, progress))
    return 0


def _pivot(args: argparse.Namespace) -> int:
    from us_sim.tracking.calibration.recording_commands import calibrate_tip

    print(calibrate_tip(args.recording, args.pose, _new(args.out)))
    return 0


def _landmarks(args: argparse.Namespace) -> int:
    from us_sim.tracking.calibration.recording_commands import calibrate_registration

    print(
        calibrate_registration(
            args.known,
            args.measured,
            args.tip,
            args.pose,
            args.to,
            _new(args.out),
            invert=args.invert,
        )
    )
    return 0


def _probe(args: argparse.Namespace) -> int:
    from us_sim.tracking.calibration.probe_command import calibrate_image

    print(
        calibrate_image(
            args.sightings,
            args.phantom,
            args.recording,
            args.pose,
            args.registration,
            (args.origin[0], args.origin[1]),
            None if args.pixel is None else (args.pixel[0], args.pixel[1]),
            _new(args.out),
        )
    )
    return 0


def _time(args: argparse.Namespace) -> int:
    from us_sim.progress import late_progress
    from us_sim.tracking.calibration.recording_commands import calibrate_clock

    names = (args.pose, args.fixed_pose or args.pose)
    out = _new(args.out)
    progress = late_progress("reading images")
    print(
        calibrate_clock(
            args.moving,
            args.fixed,
            names,
            args.largest,
            out,
            images=args.images,
            progress=progress,
        )
    )
    return 0


def _new(path: Path) -> Path:
    """A file that is still to be written, which is worth knowing before the work."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise CalibrationError(f"--out {path}: must be a file that ends in .yaml")
    if path.exists():
        raise CalibrationError(f"--out {path}: exists already; choose another name")
    if not path.absolute().parent.is_dir():
        raise CalibrationError(f"--out {path}: there is no folder {path.absolute().parent}")
    return path
