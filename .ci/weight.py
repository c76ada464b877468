#!/usr/bin/env python3
"""Print the lines of Python in each room; fail where one is over its line in budget.toml.

usage: .ci/weight.py [REVISION]   (with the change since that revision)
"""

import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

HERE = Path(__file__).resolve().parent


def git(*words: str) -> list[str]:
    """Return the lines that a git command prints of the Python files, or end as it does."""
    command = ["git", *words, "--", "us_sim/*.py", "tests/*.py"]
    ran = subprocess.run(command, cwd=HERE.parent, stdout=subprocess.PIPE, text=True, check=False)
    if ran.returncode:
        sys.exit(ran.returncode)
    return ran.stdout.splitlines()


def room(file: str) -> str:
    """Return the folder of us_sim that a file is in, `top`, or `tests`."""
    package, *rest = file.split("/")
    return package if package == "tests" else rest[0] if rest[1:] else "top"


lines: Counter[str] = Counter()
for row in git("grep", "--untracked", "--count", ""):
    file, _, count = row.rpartition(":")
    lines[room(file)] += int(count)
change: Counter[str] = Counter()
for row in git("diff", "--numstat", "--no-renames", *sys.argv[1:2]):
    added, removed, file = row.split("\t")
    change[room(file)] += int(added) - int(removed)

budget = tomllib.loads((HERE / "budget.toml").read_text(encoding="utf-8"))
over = [name for name in lines if lines[name] > budget.get(name, 0)]
print("room          lines  change  budget")
for name, count in lines.most_common():
    note = "  over" if name in over else ""
    print(f"{name:11} {count:7,} {change[name]:+7,} {budget.get(name, 0):7,}{note}")
if over:
    sys.exit(f"over the lines that .ci/budget.toml allows: {', '.join(over)}")
