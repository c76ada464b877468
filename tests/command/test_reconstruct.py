"""`us-sim reconstruct`: what it writes and says, and what it refuses."""

import numpy as np
import pytest
from sweep_file import write_sweep

from us_sim.command.main import main
from us_sim.volume.cases.case import read_case

PIXEL = 1e-3


@pytest.fixture
def sweep(tmp_path):
    rng = np.random.Generator(np.random.PCG64(3))
    block = rng.integers(40, 200, (12, 10, 14), dtype=np.uint8)  # frames, rows, columns
    matrices = np.tile(np.diag([PIXEL, PIXEL, PIXEL, 1.0]), (12, 1, 1))
    matrices[:, 2, 3] = PIXEL * np.arange(12)
    matrices[:, 0, 3] = 0.02
    more = {"Seq_Frame0003_ImageStatus": "INVALID"}
    return write_sweep(tmp_path / "doe_jane.igs.mha", block, matrices, **more), block


def test_a_sweep_becomes_a_case_that_says_what_was_done_and_not_of_whom(sweep, tmp_path):
    path, _ = sweep
    out = tmp_path / "arm"
    options = ["--spacing", "1 mm", "--clip", "0", "0", "9", "9"]
    assert main(["reconstruct", str(path), "--out", str(out), *options]) == 0
    case = read_case(out)
    assert case.read_volume().shape == (10, 10, 12)
    assert case.settings.probe.geometry == "linear"  # as wide as the rectangle that is used
    assert case.settings.probe.array.given.aperture == pytest.approx(10 * PIXEL)
    assert len(case.settings.scanned) == 11
    assert case.settings.start.proposed
    assert case.settings.start.position == case.settings.scanned[5].position
    written = "".join(file.read_text("latin-1") for file in out.glob("*.yaml"))
    assert "doe" not in written
    assert str(tmp_path) not in written


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--reference", "Table"], "from Image to Table; the known ones are ImageToReference"),
        (["--spacing", "0.5"], "did you mean '0.5 mm'"),
        (["--fan-origin", "3", "4"], "--fan-radius: is missing"),
        (["--undo-pressure", "liver_sweep"], "volume.file: is missing"),
    ],
)
def test_what_cannot_be_is_one_sentence_and_leaves_nothing(
    sweep, tmp_path, capsys, options, message
):
    path, _ = sweep
    before = sorted(tmp_path.iterdir())
    out = tmp_path / "made"
    assert main(["reconstruct", str(path), "--out", str(out), *options]) == 1
    (said,) = capsys.readouterr().err.strip().splitlines()
    assert message in said
    assert sorted(tmp_path.iterdir()) == before


def test_nothing_is_written_over(sweep, tmp_path, capsys):
    path, _ = sweep
    (tmp_path / "volume.png").write_text("mine")
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "volume.nrrd")]) == 1
    assert "volume.png: exists already" in capsys.readouterr().err


def test_an_ending_of_something_else_is_no_case(sweep, tmp_path, capsys):
    path, _ = sweep
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "liver.png")]) == 1
    assert "liver.png: its name ends as no volume's does" in capsys.readouterr().err
