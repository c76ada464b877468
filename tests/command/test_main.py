"""The command's error paths: one sentence, status 1, no traceback."""

import errno
import io
import os
import subprocess
import sys

import pytest

from us_sim.command.main import main
from us_sim.progress import ProgressBar
from us_sim.recording.writer import BagWriter
from us_sim.run.supervision import SupervisionSettings, Supervisor, print_above_bar

LONG = "x" * 300  # more than a file's name may have


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["run", "nowhere"], "there is no scene file nowhere; installed scenes are"),
        (["run", "upper_arm", "--duration", "-1"], "--duration: -1 s is outside 0.001 to"),
        (["run", "upper_arm", "--dry-run", "--param", "x"], "--param x: write NODE.NAME=VALUE"),
        (
            ["run", "upper_arm", "--dry-run", "--param", "skin.a=1"],
            "--param skin: this scene does not run such a node",
        ),
        (["run", "upper_arm", "--record", "a.bag"], "must be a file that ends in .mcap"),
        (["play", "press_and_slide.mcap", "--rate", "-1"], "--rate: -1 is outside 0.01 to 100"),
        (["view", "--attach", "--param", "skin.a=1"], "--param skin: --attach starts the viewer"),
        (["run", "upper_arm", "--port", "3"], "are the viewer's: add --view"),
        (["run", "liver_sweep", "--dry-run"], "volume.file: is missing"),
        (["evaluate", "hand", "--seed", "-1"], "--seed: -1 is outside 0 to"),
        (["demo", "upper_arm", "--volume", "nowhere.mha"], "there is no file"),
        (["run", LONG, "--dry-run"], "there is no scene file xxx"),
        (["bag", "info", LONG], "there is no bag at xxx"),
        (["view", "compression"], "did you mean exercise:compression?"),
        (["view", "exercise:centre", "--results", f"{__file__}/x"], "/x: cannot be written"),
        (["view", "exercise:centre", "--results", "no-such://x"], "no-such://x: cannot be written"),
    ],
)
def test_bad_input_is_one_sentence(args, words, capsys):
    assert main(args) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.startswith("us-sim: ")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("args", "meant"),
    [
        (["vew"], "view"),
        (["view", "--recrod", "a.mcap"], "--record"),
        (["evaluate", "hand", "--sed", "1"], "--seed"),
    ],
)
def test_a_misspelt_command_or_option_is_told_the_one_that_was_meant(args, meant, capsys):
    with pytest.raises(SystemExit) as ended:
        main(args)
    assert ended.value.code == 2
    assert f"did you mean '{meant}'?" in capsys.readouterr().err


@pytest.mark.parametrize(
    "args",
    [
        ["run", "LOOP.yaml", "--dry-run"],
        ["run", "upper_arm", "--dry-run", "--volume", "LOOP.mha"],
        ["play", "~nobody-of-that-name/a.mcap"],
        ["bag", "info", "LOOP.mcap"],
        ["import", "LOOP", "--out", "a"],
    ],
)
def test_links_that_lead_in_a_circle_are_one_sentence(args, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for end in ("", ".yaml", ".mha", ".mcap"):
        (tmp_path / f"LOOP{end}").symlink_to(f"LOOP{end}")
    assert main(args) == 1
    error = capsys.readouterr().err
    assert error.startswith("us-sim: ")
    assert error.count("\n") == 1
    assert args[-1].rpartition("/")[2] in error or "LOOP" in error


class Full(io.StringIO):
    """A stream to a full disk."""

    def write(self, _):
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("stream", [None, Full()])
def test_without_standard_error_work_goes_on(stream, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sys, "stderr", stream)
    assert main(["bag", "info", "nowhere.mcap"]) == 1
    file = tmp_path / "a.mcap"
    BagWriter(file).close()
    assert main(["bag", "info", str(file)]) == 0
    assert "messages  0" in capsys.readouterr().out
    assert sys.stderr is stream


def test_what_strangers_say_moves_no_cursor_and_fills_no_screen(capsys):
    hostile = "\x1b[2J\x1b]0;owned\x07\r\u202e" + "x" * 10_000
    print_above_bar(hostile)
    with ProgressBar("running", 1, "s") as bar:
        bar.update(0.5, hostile)
    Supervisor(SupervisionSettings())._show("scorer", hostile)
    error = capsys.readouterr().err
    assert not set("\x1b\x07\u202e") & set(error)
    assert len(error) < 6_000


@pytest.mark.parametrize("module", ["argparse", "us_sim.recording.reader"])
def test_ctrl_c_while_something_is_imported_is_one_sentence(module, tmp_path):
    """The signal comes at the import of a module, as early as the command has any."""
    program = (
        "import os, signal, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path, target=None):\n"
        f"        if name == {module!r}: os.kill(os.getpid(), signal.SIGINT)\n"
        "from us_sim.command.main import main\n"
        f"sys.modules.pop({module!r}, None)\n"
        "sys.meta_path.insert(0, Finder())\n"
        "sys.exit(main(['bag', 'info', 'nowhere.mcap']))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (ran.stderr, ran.returncode) == ("us-sim: interrupted\n", 130)


def test_ctrl_c_in_a_text_that_is_executed_has_the_status_of_ctrl_c(tmp_path):
    """As where a dataclass is made: there CPython remembers a plain KeyboardInterrupt."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, signal, sys\n"
        "class Finder:\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name == 'us_sim.recording.reader':\n"
        "            exec('os.kill(os.getpid(), signal.SIGINT)')\n"
        "sys.meta_path.insert(0, Finder())\n"
    )
    search = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "us_sim", "bag", "info", "nowhere.mcap"]
    ran = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": search}, capture_output=True, text=True
    )
    assert (ran.stderr, ran.returncode) == ("us-sim: interrupted\n", 130)


def test_what_is_not_chosen_is_not_imported():
    code = (
        "import sys; from us_sim.command.main import main\n"
        "try: main(['calibrate', 'pivot', '--help'])\n"
        "except SystemExit: pass\n"
        "names = ('cv2', 'numpy', 'matplotlib', 'us_sim.evaluation', 'us_sim.nodes')\n"
        "sys.exit(str([name for name in names if name in sys.modules] or 0))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.stderr.strip() in ("", "0")
    assert "--recording" not in run.stdout
    assert "tip.yaml" in run.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_too_little_memory_is_named():
    program = (
        "import resource, sys\n"
        "from us_sim.command import main as command\n"
        "resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))\n"
        "command._make_parser = lambda: bytearray(4 << 30)\n"
        "sys.exit(command.main([]))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 1
    assert "not enough memory" in ran.stderr
    assert "Traceback" not in ran.stderr
