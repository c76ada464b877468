"""`us-sim segment` on a case and on a volume file: all of it, or nothing."""

import numpy as np
import pytest
import yaml

from us_sim.command.main import main
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.reading import SettingsReader
from us_sim.volume.cases.case import read_case
from us_sim.volume.cases.settings import CaseSettings, CaseStart, CaseStructure
from us_sim.volume.cases.writing import new_case, write_case_settings
from us_sim.volume.files.labels import read_labels
from us_sim.volume.files.writing import write_labels, write_volume
from us_sim.volume.volume import Volume

SEEDS = """structures:
  vein: {upper: 40, seeds_mm: [[0, 0, 19]]}
  body: {lower: 1, seeds_mm: [[0, 0, 40]]}
"""


def block():
    """60 × 40 × 50 mm of speckle around a dark tube along y."""
    grid = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    grid[:3, 3] = [-0.03, -0.02, 0.0]
    grey = np.random.default_rng(1).integers(60, 120, (30, 20, 25), dtype=np.uint8)
    labels = np.zeros_like(grey)
    labels[13:17, :, 8:11] = 6
    grey[labels == 6] = 10
    return Volume(grey, grid, labels, {6: "vein"})


@pytest.fixture
def case(tmp_path):
    """The block's, unlabelled, with a structure's material."""
    structures = {"vein": CaseStructure(3, material="artery"), "bone": CaseStructure(1)}
    with new_case(tmp_path / "arm") as folder:
        write_volume(folder / "volume.nrrd", block())
        probe = SettingsReader("probe").read(ProbeSettings, {"aperture": "30 mm", "depth": "40 mm"})
        start = CaseStart()  # to propose both takes long
        fixed = ("bottom", "bone")
        settings = CaseSettings("arm", "", "", probe, start, structures=structures, fixed=fixed)
        write_case_settings(folder, settings)
    return tmp_path / "arm"


@pytest.fixture
def seeds(tmp_path):
    """The file of seeds."""
    (tmp_path / "seeds.yaml").write_text(SEEDS)
    return str(tmp_path / "seeds.yaml")


def contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.slow
def test_seeds_make_labels_surfaces_and_a_picture(case, seeds, capsys):
    assert main(["segment", str(case), "--seeds", seeds]) == 0
    said = capsys.readouterr().out
    opened = read_case(case)
    volume = opened.read_volume()
    assert volume.label_names == {0: "tissue", 1: "vein", 2: "body"}
    np.testing.assert_array_equal(volume.labels == 1, block().labels == 6)
    assert {file.stem for file in (case / "surfaces").iterdir()} == {"body", "vein"}
    assert (case / "segmentation.png").read_bytes()[:4] == b"\x89PNG"
    vein = 4 * 20 * 3 * 8e-3  # ml
    assert f"{vein:.3f} ml" in said
    assert opened.settings.structures["vein"].material == "artery"
    assert opened.settings.fixed == ("bottom",)
    labels = read_labels(case / "labels.nrrd", volume)
    assert labels.names == {1: "vein", 2: "body"}


@pytest.mark.slow
def test_labels_of_slicer_go_in_by_their_names_and_keep_no_path(case, tmp_path, capsys):
    file = tmp_path / "doe_jane.seg.nrrd"
    write_labels(file, block(), {6: (0.125, 0.25, 0.5)})
    assert main(["segment", str(case), "--labels", str(file), "--names", "6=brachial vein"]) == 0
    assert "brachial vein" in capsys.readouterr().out
    document = yaml.safe_load((case / "case.yaml").read_text())
    assert document["structures"] == {"brachial vein": {"label": 6, "colour": [0.125, 0.25, 0.5]}}
    for path, content in contents(case).items():
        assert b"doe" not in content, path
    assert main(["segment", str(case)]) == 0  # surfaces of the labels that are there
    assert [path.name for path in (case / "surfaces").iterdir()] == ["brachial vein.stl"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "no labels yet: give --labels or --seeds"),
        (["--seeds", "SEEDS", "--labels", "SEEDS"], "two sources of labels"),
        (["--seeds", "SEEDS", "--names", "3=vein"], "--names: is for --labels only"),
        (["--labels", "SEEDS", "--names", "3=a/b"], "no path"),
    ],
)
def test_what_cannot_be_done_is_one_sentence_and_changes_nothing(
    case, seeds, capsys, words, sentence
):
    (case / "case.yaml").write_text("name: arm\n")
    before = contents(case.parent)
    assert main(["segment", str(case), *(seeds if w == "SEEDS" else w for w in words)]) == 1
    error = capsys.readouterr().err
    assert sentence in error
    assert error.count("\n") == 1 + error.count("\r")
    assert contents(case.parent) == before
