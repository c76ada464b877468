#!/usr/bin/env python3
"""Print how much Python each room holds, and the change since a revision.

usage: .ci/weight.py [REVISION]

Lines, files, the median of a file's lines, and the share of lines before a file's first class or
function: of what is in the working tree, for each folder of us_sim and for the tests.
"""

import re
import statistics
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DEFINITION = re.compile(r"@|def |async def |class ")


def git(*words: str) -> str:
    """The output of a git command; fails as git does."""
    return subprocess.run(
        ["git", *words], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def measured(texts: dict[str, str]) -> dict[str, list[tuple[int, int]]]:
    """Lines of each file, and those before its first definition, by room."""
    rooms = defaultdict(list)
    for name, text in texts.items():
        package, *rest = Path(name).parts
        lines = text.splitlines()
        before = next((k for k, line in enumerate(lines) if DEFINITION.match(line)), len(lines))
        for room in (package, f"us_sim/{rest[0]}" if package == "us_sim" and rest[1:] else None):
            if room:
                rooms[room].append((len(lines), before))
    return rooms


def files_now() -> dict[str, str]:
    return {
        str(file.relative_to(ROOT)): file.read_text(encoding="utf-8")
        for folder in ("us_sim", "tests")
        for file in (ROOT / folder).rglob("*.py")
    }


def files_of(revision: str) -> dict[str, str]:
    names = git("ls-tree", "-r", "--name-only", revision, "us_sim", "tests").splitlines()
    return {name: git("show", f"{revision}:{name}") for name in names if name.endswith(".py")}


def main() -> None:
    """Print the table."""
    now = measured(files_now())
    was = measured(files_of(sys.argv[1])) if sys.argv[1:] else {}
    print(f"{'':18}  lines           files        median   before the first definition")
    for room in sorted(now.keys() | was.keys(), key=lambda r: -sum(n for n, _ in now.get(r, []))):
        sizes, old = now.get(room, []), was.get(room, [])
        lines, old_lines = (sum(n for n, _ in each) for each in (sizes, old))
        change = (f"{lines - old_lines:+,}", f"{len(sizes) - len(old):+}") if was else ("", "")
        median = statistics.median(n for n, _ in sizes) if sizes else 0
        share = 100 * sum(n for _, n in sizes) / max(lines, 1)
        print(
            f"{room:18} {lines:7,} {change[0]:>7}  {len(sizes):5} {change[1]:>5}"
            f"  {median:8.0f}  {share:6.1f} %"
        )


if __name__ == "__main__":
    main()
