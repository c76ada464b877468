"""The command `us-sim`."""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import sys
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TextIO, cast

from us_sim.errors import UsSimError, printable_line

if TYPE_CHECKING:
    import argparse

    from us_sim.command.options import ChosenParser

_ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


_COMMANDS = (
    ("view", "simulation", "take the probe in a browser, and see what it images"),
    ("demo", "simulation", "press on the virtual arm; images, summary, recording"),
    ("run", "simulation", "run the nodes of a scene until Ctrl-C"),
    ("render", "simulation", "one image for every pose of a path, repeatably"),
    ("play", "simulation", "play a bag's probe path into a running simulation"),
    ("bag", "bag", "look at recordings"),
    ("score", "score", "score a recorded scan: motion, force, areas"),
    ("param", "param", "parameters of running nodes, as ros2 param lists, gets and sets them"),
    ("cases", "volumes", "list cases: what they are of, and how to scan them"),
    (
        "import",
        "volumes",
        "de-identify files of scanners into a volume, a case or a sequence of images",
    ),
    ("calibrate", "measuring", "find out where trackers and tools are"),
    (
        "fit-stiffness",
        "fit_stiffness",
        "Young's moduli of a scene's structures, from a recorded press with force",
    ),
    (
        "press",
        "press",
        "the depth at which a probe pushes with a force, and the strain of each label",
    ),
    ("dataset", "dataset", "images with every truth, of episodes drawn by a seed"),
    ("reconstruct", "volumes", "make a volume or a case of a tracked sweep"),
    (
        "segment",
        "volumes",
        "structures of a case from labels, seeds or a search, and their surfaces",
    ),
    ("print-marker", "measuring", "PDF or PNG of markers, at true scale"),
    ("evaluate", "measuring", "measure: CSV, pictures and a report"),
    (
        "reference",
        "reference",
        "topics, node parameters and scene settings, with ranges and defaults",
    ),
)
"""Each command, the module in which NAME_options adds its options, and its help."""


class _Interrupted(KeyboardInterrupt):
    """Ctrl-C, as a class of its own: a plain `KeyboardInterrupt` that has passed through an `exec`
    of text, as where a dataclass is imported, makes Python end as killed by SIGINT (CPython's
    pythonrun.c), whatever the exit status."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; 0 when it did its work, 1 with a sentence for bad input, 130 on Ctrl-C."""
    ended: list[int] = []

    def interrupt(number: int, _: object) -> None:
        """End as on Ctrl-C, so that no node outlives the command."""
        ended.append(number)
        raise _Interrupted

    before = {number: signal.signal(number, interrupt) for number in _ENDINGS}
    said, sys.stderr = sys.stderr, cast(TextIO, _Lasting(sys.stderr))
    try:
        from us_sim.run.domain import take_ros_arguments

        parsed = _parser().parse_args(take_ros_arguments(sys.argv[1:] if args is None else args))
        return int(parsed.command(parsed) or 0)
    except UsSimError as error:
        _say(str(error))
        return 1
    except KeyboardInterrupt:
        return _interrupted()
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except MemoryError:
        _say("there is not enough memory")
        return 1
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _say(f"{where}{error.strerror or error}")
        return 1
    except Exception:
        if not ended:
            raise
        return _interrupted()  # a library that is broken off while it is imported fails in its way
    finally:
        sys.stderr = said
        for number, handler in before.items():
            signal.signal(number, handler)


class _Lasting:
    """Standard error that may be closed, or lead to a full disk: no work ends for that."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _parser() -> ChosenParser:
    """All commands; imported here, where an interruption is one sentence already."""
    from us_sim import __version__
    from us_sim.command.options import ChosenParser

    parser = ChosenParser(
        prog="us-sim", description="Interactive simulation of compression ultrasonography."
    )
    parser.add_argument("--version", action="version", version=f"us-sim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, module, text in _COMMANDS:
        commands.add_parser(name, help=text, add_options=partial(_add_options, name, module))
    return parser


def _add_options(name: str, module: str, parser: argparse.ArgumentParser) -> None:
    commands = importlib.import_module(f"us_sim.command.{module}")
    getattr(commands, f"{name.replace('-', '_')}_options")(parser)


def _interrupted() -> int:
    _say("interrupted")
    return 130


def _say(sentence: str) -> None:
    """On stderr, on a line of its own below bars of work that was broken off."""
    progress = sys.modules.get("us_sim.progress")  # which costs time to import
    if progress is not None:
        progress.end_late_bars()
    print(f"us-sim: {printable_line(sentence)}", file=sys.stderr)
