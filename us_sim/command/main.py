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
"""Name of each command, the module whose NAME_options adds the options, and the help."""


class _Interrupted(KeyboardInterrupt):
    """Ctrl-C, as a class of its own.

    A plain `KeyboardInterrupt` that has passed through an `exec` of text, as in the import of a
    dataclass, makes Python end as killed by SIGINT (CPython's pythonrun.c), whatever the status.
    """


def main(args: Sequence[str] | None = None) -> int:
    """Run a command; return 0, 1 after a sentence on bad input, or 130 on Ctrl-C."""
    signals: list[int] = []

    def interrupt(number: int, _: object) -> None:
        """End as on Ctrl-C, so that no node outlives the command."""
        signals.append(number)
        raise _Interrupted

    before = {number: signal.signal(number, interrupt) for number in _ENDINGS}
    stderr, sys.stderr = sys.stderr, cast(TextIO, _LastingStream(sys.stderr))
    try:
        from us_sim.run.domain import take_ros_arguments

        words = take_ros_arguments(sys.argv[1:] if args is None else args)
        parsed = _make_parser().parse_args(words)
        return int(parsed.command(parsed) or 0)
    except UsSimError as error:
        _print_error(str(error))
        return 1
    except KeyboardInterrupt:
        return _report_interruption()
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except MemoryError:
        _print_error("there is not enough memory")
        return 1
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _print_error(f"{where}{error.strerror or error}")
        return 1
    except Exception:
        if not signals:
            raise
        return _report_interruption()  # an interrupted import of a library fails in its own way
    finally:
        sys.stderr = stderr
        for number, handler in before.items():
            signal.signal(number, handler)


class _LastingStream:
    """Standard error that may be closed, or lead to a full disk, without ending any work."""

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


def _make_parser() -> ChosenParser:
    """Make the parser of all commands; an interruption of its imports is one sentence."""
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


def _report_interruption() -> int:
    _print_error("interrupted")
    return 130


def _print_error(sentence: str) -> None:
    """Print a sentence to stderr, on a line of its own below the bars of unfinished work."""
    if "tqdm" in sys.modules:  # which costs time to import
        for bar in [*sys.modules["tqdm"].tqdm._instances]:
            bar.close()
    print(f"us-sim: {printable_line(sentence)}", file=sys.stderr)
