"""The command `us-sim`."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TextIO, cast

from us_sim.errors import UsSimError, memory_limit, printable

if TYPE_CHECKING:
    from us_sim.command.options import ChosenParser

_ENDINGS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main(args: Sequence[str] | None = None) -> int:
    """Run one command; 0 when it did its work, 1 with a sentence for bad input, 130 on Ctrl-C."""
    ended: list[int] = []

    def interrupt(number: int, _: object) -> None:
        """End as on Ctrl-C, so that no node outlives the command."""
        ended.append(number)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in _ENDINGS}
    said, sys.stderr = sys.stderr, cast(TextIO, _Lasting(sys.stderr))
    try:
        parsed = _parser().parse_args(args)
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
        _say("; ".join(filter(None, ["there is not enough memory", memory_limit()])))
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
        if stream is None:  # nothing else may get its descriptor
            while (file := os.open(os.devnull, os.O_WRONLY)) < 2:
                pass
            if file > 2:
                os.close(file)
            stream = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        self._stream = stream

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
    from us_sim.command.bag import add_bag
    from us_sim.command.fit_stiffness import add_fit_stiffness
    from us_sim.command.measuring import add_calibrate, add_compile, add_evaluate, add_print_marker
    from us_sim.command.options import ChosenParser
    from us_sim.command.reference import add_reference
    from us_sim.command.simulation import add_demo, add_play, add_render, add_run, add_view
    from us_sim.command.volumes import add_cases, add_import, add_reconstruct, add_segment

    parser = ChosenParser(
        prog="us-sim", description="Interactive simulation of compression ultrasonography."
    )
    parser.add_argument("--version", action="version", version=f"us-sim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add in (add_view, add_demo, add_run, add_render, add_play, add_bag, add_cases):
        add(commands)
    for add in (
        add_import,
        add_calibrate,
        add_fit_stiffness,
        add_reconstruct,
        add_segment,
        add_print_marker,
        add_evaluate,
        add_reference,
        add_compile,
    ):
        add(commands)
    return parser


def _interrupted() -> int:
    _say("interrupted")
    return 130


def _say(sentence: str) -> None:
    """On stderr, on a line of its own below bars of work that was broken off."""
    progress = sys.modules.get("us_sim.progress")  # which costs time to import
    if progress is not None:
        progress.end_late_bars()
    print(f"us-sim: {printable(sentence)}", file=sys.stderr)
