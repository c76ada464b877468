"""The process that reads changed files, one after the other, and may die of it.

It says the number of a case before it begins, and a word on one that failed after it:
lines of JSON on stdout, which `tests.fuzz` reads.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.mutation import mutated
from tests.fuzz.target import TARGETS, Target, add_targets
from us_sim.errors import UsSimError

FOUND = Path(__file__).parent / "found"
"""Files that a reader once failed on, in a folder for each target; they are read first."""

_MEMORY = 3 << 30
"""Bytes that the process may take more than it has at its beginning."""


class TooSlowError(BaseException):
    """No Exception, which a reader might take for a damaged file's."""


def content_of(target: Target, seeds: list[bytes], run: int, number: int) -> bytes:
    """The changed file of a number; negative numbers are those that were found."""
    if number < 0:
        return found_of(target)[number].read_bytes()
    return mutated(seeds, Random(f"{run} {target.name} {number}"))


def found_of(target: Target) -> list[Path]:
    """Files that the target once failed on."""
    folder = FOUND / target.name
    return sorted(folder.iterdir()) if folder.is_dir() else []


def main(task: dict[str, Any]) -> None:
    """Read the cases ``first`` to ``last`` of every target in turn; of the first, some are done."""
    folder = Path(task["folder"])
    say, sys.stdout = sys.stdout, sys.stderr  # what a library prints is none of ours
    add_targets(task["modules"])
    chosen = [TARGETS[name] for name in task["targets"]]
    seeds: dict[str, list[bytes]] = {}
    for target in chosen:
        with tempfile.TemporaryDirectory(dir=folder) as own:
            seeds[target.name] = list(target.seeds(Path(own)))
            if task["first"] < 0:
                _check_seeds(target, seeds[target.name], Path(own))

    def out_of_time(*_: object) -> None:
        raise TooSlowError

    signal.signal(signal.SIGPROF, out_of_time)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    bound = pages * resource.getpagesize() + _MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
    first = max(task["first"], -max(len(found_of(target)) for target in chosen))
    for number in range(first, task["last"]):
        for target in chosen[task["done"] if number == task["first"] else 0 :]:
            if number < -len(found_of(target)):
                continue
            print(json.dumps({"target": target.name, "number": number}), file=say, flush=True)
            content = content_of(target, seeds[target.name], task["run"], number)
            why = _failure(target, content, folder, task["limit"])
            if why:
                said = {"target": target.name, "number": number, "failure": why}
                print(json.dumps(said), file=say, flush=True)


def _check_seeds(target: Target, seeds: list[bytes], folder: Path) -> None:
    """Read them whole: a refused one would not be read far when it is changed."""
    for number, seed in enumerate(seeds):
        file = folder / f"seed{number}{target.suffix}"
        file.write_bytes(seed)
        target.read(file)


def _failure(target: Target, content: bytes, folder: Path, limit: float) -> str:
    """Why a reader did not do what it should with that; empty where it did."""
    own = Path(tempfile.mkdtemp(dir=folder))
    file = own / f"changed{target.suffix}"
    file.write_bytes(content)
    # Processor time, so that another program's work makes no failure of a case.
    signal.setitimer(signal.ITIMER_PROF, limit)
    try:
        target.read(file)
    except UsSimError as error:
        if "\n" in str(error) or len(str(error)) > 3000:
            return f"no single sentence: {str(error)[:3000]}"
    except TooSlowError:
        return f"more than {limit} s of processor time\n{traceback.format_exc()}"
    except BaseException:
        return traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        with contextlib.suppress(OSError):
            shutil.rmtree(own)
    return ""


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
