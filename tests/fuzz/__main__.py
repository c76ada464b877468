"""Readers given changed files: `python -m tests.fuzz --minutes 60`.

Every reader must end with a result or one sentence, within a second and bounded memory. A case is
a number: the same run, target and number give the same file again. What failed is written to a
folder, with the reason beside it; a file of it that goes to `tests/fuzz/found/TARGET` is read
first from then on, in the tests, too.
"""

from __future__ import annotations

import argparse
import json
import os
import selectors
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.fuzz.target import MODULES, TARGETS, add_targets
from tests.fuzz.worker import content_of

_HANG = 60.0
"""Seconds without a word, after which the process is ended: code that no signal interrupts."""

_FIRST = -1000
"""The number of the first case; those below 0 are files that were found before."""

_FOREVER = 1 << 40


def main() -> int:
    """Run the cases, and say how many failed; 1 where any did."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", help="by name; default: all")
    parser.add_argument("--module", nargs="*", default=MODULES, help="where targets are")
    parser.add_argument("--minutes", type=float, help="how long")
    parser.add_argument("--cases", type=int, default=_FOREVER, help="of every target")
    parser.add_argument("--run", type=int, default=1, help="a number; another gives other cases")
    parser.add_argument("--limit", type=float, default=1.0, help="s of processor time for a case")
    parser.add_argument("--out", type=Path, default=Path("fuzz_failures"))
    args = parser.parse_args()
    add_targets(args.module)
    if unknown := set(args.targets) - set(TARGETS):
        parser.error(f"there is no target {unknown.pop()}; targets are {', '.join(TARGETS)}")
    if args.minutes is None and args.cases == _FOREVER:
        parser.error("say how long: --minutes or --cases")
    names = args.targets or list(TARGETS)
    cases: Counter[str] = Counter()
    failures: Counter[str] = Counter()
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="us_sim_fuzz_") as folder:
        task = {"targets": names, "run": args.run, "limit": args.limit, "last": args.cases}
        task |= {"modules": list(args.module), "folder": folder, "first": _FIRST, "done": 0}
        for said in _all_said(task, begun + 60 * args.minutes if args.minutes else None):
            if "failure" in said:
                failures[said["target"]] += 1
                _write(args.out, said, args.run, folder)
            else:
                cases[said["target"]] += 1
    for name in names:
        print(f"{name:12} {cases[name]:9} cases {failures[name]:6} failed")
    print(f"{cases.total()} cases in {time.monotonic() - begun:.0f} s")
    if failures:
        print(f"{failures.total()} failures are in {args.out}")
    return 1 if failures else 0


def _all_said(task: dict[str, Any], until: float | None) -> Iterator[dict[str, Any]]:
    """The lines of workers; where one dies of a case, that is said, and another one goes on."""
    while True:
        case = None
        command = [sys.executable, "-m", "tests.fuzz.worker", json.dumps(task)]
        with (
            tempfile.TemporaryFile() as noise,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=noise) as process,
        ):
            for line in _lines(process, until):
                if line is None:
                    process.kill()
                    break
                case = json.loads(line)
                yield case
            status = process.wait()
            noise.seek(max(0, noise.tell() - 3000))
            words = noise.read().decode(errors="replace")
        if until is not None and time.monotonic() > until:
            return
        if status == 0:
            return
        if case is None:
            raise RuntimeError(f"the worker does not begin: {words}")
        if "failure" not in case:
            yield case | {"failure": f"the process ended with status {status}\n{words}"}
        done = task["targets"].index(case["target"]) + 1
        task = task | {"first": case["number"], "done": done}


def _lines(process: subprocess.Popen[bytes], until: float | None) -> Iterator[bytes | None]:
    """The lines of a process; None once it is silent for too long, or the time is over."""
    assert process.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        rest = b""
        while True:
            wait = _HANG if until is None else max(0.0, min(_HANG, until - time.monotonic()))
            if not selector.select(wait):
                yield None
                return
            piece = os.read(process.stdout.fileno(), 1 << 16)
            if not piece:
                return
            *whole, rest = (rest + piece).split(b"\n")
            yield from whole
            if until is not None and time.monotonic() > until:
                yield None
                return


def _write(out: Path, said: dict[str, Any], run: int, folder: str) -> None:
    """The file of a case that failed, and why it did."""
    target = TARGETS[said["target"]]
    own = Path(tempfile.mkdtemp(dir=folder))
    content = content_of(target, list(target.seeds(own)), run, said["number"])
    out.mkdir(parents=True, exist_ok=True)
    name = f"{target.name}-{run}-{said['number']}"
    (out / f"{name}{target.suffix}").write_bytes(content)
    (out / f"{name}.txt").write_text(said["failure"], encoding="utf-8")
    print(f"{name}: {said['failure'].strip().splitlines()[-1][:150]}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
