"""Some changed files of every kind, the same ones in every run, and all that ever failed.

`python -m tests.fuzz` reads more of them.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def fuzz(*args, **environment):
    """The command, as a person runs it."""
    return subprocess.run(
        [sys.executable, "-m", "tests.fuzz", *map(str, args)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_no_reader_fails_on_a_changed_file(tmp_path):
    ran = fuzz("--cases", 20, "--limit", 20, "--out", tmp_path / "failures")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "0 failed" in ran.stdout


TRAPS = """
import os
from tests.fuzz.target import target
from us_sim.errors import UsSimError

def trap(name):
    def add(read):
        def sprung(path):
            if path.read_bytes() != b"whole":
                read()
        return target(name, ".txt", lambda folder: [b"whole"])(sprung)
    return add

@trap("raises")
def raises():
    raise KeyError("not there")

@trap("loops")
def loops():
    while True:
        pass

@trap("hoards")
def hoards():
    return bytearray(1 << 36)

@trap("dies")
def dies():
    os.abort()

@trap("refuses")
def refuses():
    raise UsSimError("it is damaged: copy it again")
"""


def test_every_kind_of_failure_is_noticed_and_the_others_go_on(tmp_path):
    (tmp_path / "traps.py").write_text(TRAPS)
    out = tmp_path / "failures"
    path = os.pathsep.join(map(str, [tmp_path, ROOT]))
    ran = fuzz(
        "--module", "traps", "--cases", 1, "--run", 2, "--limit", 0.1, "--out", out, PYTHONPATH=path
    )
    assert ran.returncode == 1, ran.stdout + ran.stderr
    last = {file.stem[:-4]: file.read_text().splitlines()[-1] for file in out.glob("*-2-0.txt")}
    assert set(last) == {"raises", "loops", "hoards", "dies"}
    assert "KeyError" in last["raises"]
    assert "TooSlowError" in last["loops"]
    assert "MemoryError" in last["hoards"]
    assert "status -6" in (out / "dies-2-0.txt").read_text()
