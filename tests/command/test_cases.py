"""`us-sim cases` says what there is, draws it, and says what is wrong with the rest."""

import re

import numpy as np
import pytest

from us_sim.command.main import main
from us_sim.settings.reading import SettingsReader
from us_sim.volume.cases.settings import CaseSettings, CaseStart, CaseStructure
from us_sim.volume.cases.writing import new_case, write_case_settings
from us_sim.volume.files.writing import write_labels, write_volume
from us_sim.volume.volume import Volume


@pytest.fixture
def cases(tmp_path, monkeypatch):
    """A folder with the case `arm`, 60 × 40 × 50 mm, of which z is the depth."""
    grid = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    grid[:3, 3] = [-29e-3, -19e-3, 1e-3]
    labels = np.zeros((30, 20, 25), np.uint8)
    labels[12:18, :, 8:13] = 6
    volume = Volume(np.full(labels.shape, 120, np.uint8), grid, labels)
    probe = {"aperture": "30 mm", "depth": "40 mm", "image": [150, 200]}
    document = {"name": "arm", "region": "upper arm", "probe": probe}
    settings = SettingsReader("case").read(CaseSettings, document)
    structures = {"vein": CaseStructure(6, colour=(0.0, 0.0, 1.0))}
    with new_case(tmp_path / "cases" / "arm") as folder:
        write_volume(folder / "volume.nrrd", volume)
        write_labels(folder / "labels.nrrd", volume)
        made = CaseSettings("arm", "upper arm", "", settings.probe, CaseStart())
        write_case_settings(folder, CaseSettings(**{**vars(made), "structures": structures}))
    monkeypatch.setenv("US_SIM_CASES", str(tmp_path / "cases"))
    return tmp_path / "cases"


def test_a_broken_case_is_said_beside_the_good_ones(cases, capsys):
    (cases / "bad").mkdir()
    (cases / "bad" / "case.yaml").write_text("name: bad\n")
    assert main(["cases"]) == 1
    titles, arm, bad = capsys.readouterr().out.splitlines()
    assert titles.split() == ["case", "region", "probe", "size", "structures"]
    facts = ["arm", "upper arm", "linear, 40 mm deep", "60 × 40 × 50 mm, voxels of 2 mm", "vein"]
    assert re.split(" {2,}", arm.strip()) == facts
    assert "bad: is no case, as it has no volume.nrrd" in bad


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["cases", "/proc/nowhere"], "/proc/nowhere: cannot be read"),
        (["run", "--dry-run"], "name a scene, or a case with --case"),
        (["run", "upper_arm", "--case", "arm", "--dry-run"], "the scene upper_arm is given too"),
        (["demo", "--case", "amr"], "did you mean 'arm'?"),
    ],
)
@pytest.mark.usefixtures("cases")
def test_wrong_words_are_refused_in_a_sentence(words, sentence, capsys):
    assert main(words) == 1
    assert sentence in capsys.readouterr().err


def test_a_case_runs_dry(cases, capsys):
    assert main(["run", "--case", "arm", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert f"scene arm (case:{cases / 'arm'}), volume case arm" in said
    assert "the scene has `tissue`" in said
