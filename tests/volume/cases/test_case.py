"""Cases as they were written, by name in several folders, and broken ones."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from us_sim.errors import CaseError
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.reading import SettingsReader
from us_sim.tissue.elasticity.material import Material
from us_sim.volume.cases.case import find_case, list_case_roots, read_case
from us_sim.volume.cases.settings import CaseSettings, CaseStart, CaseStructure
from us_sim.volume.files.writing import write_labels
from us_sim.volume.volume import Volume


def test_a_case_is_read_as_it_was_made(make_case, block):
    probe = {"geometry": "convex", "radius": "50 mm", "opening_angle": "60 deg", "depth": "18 cm"}
    probe["collider"] = {"shape": "sphere", "radius": "2 cm"}
    made = CaseSettings(
        "block",
        "forearm",
        "A block: 60 × 40 × 50 mm",
        SettingsReader("probe").read(ProbeSettings, probe),
        CaseStart((0.01, 0, 0), (0.0, 1.0, 0.0, 0.0)),
        7e-3,
        Material(5e3, 0.49),
        {"vein": CaseStructure(6, Material(1e3, 0.1, 1060.0, 800.0), (0.1, 0.2, 0.3))},
        fixed=("bottom", "sides"),
    )
    case = read_case(make_case(settings=made))
    assert case.settings == made
    volume = case.read_volume()
    np.testing.assert_array_equal(volume.intensities, block.intensities)
    np.testing.assert_array_equal(volume.labels, block.labels)
    np.testing.assert_allclose(volume.index_to_patient, block.index_to_patient, atol=1e-15)
    assert volume.label_names == {0: "tissue", 6: "vein"}


def changed(folder, text):
    (folder / "case.yaml").write_text(text)
    return folder


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "is empty"),
        ("name: ../../etc\n", "name: '../../etc'"),
        ("name: a\nstructures: {../../up: {label: 6}}\n", "no path"),
        ("name: a\nstructures: {vein: {label: 6}, vena: {label: 6}}\n", "`vein`"),
        ("name: a\nstructures: {top: {label: 6}}\n", "something else"),
        ("name: a\nvolume: ../../../etc/passwd\n", "volume:"),
    ],
)
def test_what_a_case_cannot_say_is_refused_in_a_sentence(make_case, text, sentence):
    folder = changed(make_case(), text)
    with pytest.raises(CaseError) as refused:
        read_case(folder)
    assert sentence in str(refused.value)
    assert str(folder) in str(refused.value)


@pytest.mark.parametrize(
    ("shift", "end", "message"),
    [(1e-4, None, r"another grid.* 0\.1 mm"), (0.0, -1, r"30 × 20 × 24 .*30 × 20 × 25")],
)
def test_labels_must_be_on_the_volumes_grid(make_case, block, shift, end, message):
    folder, placed = make_case(), block.index_to_patient.copy()
    placed[0, 3] += shift
    labels = block.labels[:, :, :end]
    write_labels(folder / "labels.nrrd", Volume(labels, placed, labels))
    with pytest.raises(CaseError, match=message):
        read_case(folder).read_volume()


def test_every_label_is_a_structure_and_every_structure_is_there(make_case):
    folder = changed(make_case(), "name: a\n")
    with pytest.raises(CaseError, match="label 6"):
        read_case(folder).read_volume()
    changed(folder, "name: a\nstructures: {vein: {label: 6}, artery: {label: 7}}\n")
    with pytest.raises(CaseError, match=r"structures.artery: label 7"):
        read_case(folder).read_volume()


def test_bones_and_the_bottom_are_held_unless_the_case_says_other():
    structures = {"rib": CaseStructure(1), "vein": CaseStructure(2)}
    assert CaseSettings("a", structures=structures).held == ("bottom", "rib")
    assert CaseSettings("a", structures=structures, fixed=("sides",)).held == ("sides",)


@pytest.fixture
def roots(tmp_path, make_case, monkeypatch):
    """Two folders of cases: `arm` is in both, `liver` in the second."""
    case = make_case()
    for place in ("one/arm", "two/arm", "two/liver"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        shutil.copytree(case, tmp_path / place)
    folders = [tmp_path / "one", tmp_path / "two"]
    monkeypatch.setenv("US_SIM_CASES", os.pathsep.join(map(str, folders)))
    monkeypatch.chdir(tmp_path)
    return folders


def test_a_name_is_looked_up_in_each_root_in_order_and_a_path_goes_first(roots, monkeypatch):
    assert list_case_roots() == roots
    for name, case in (("arm", 0), ("two/arm", 1), (roots[1] / "arm", 1)):
        assert find_case(name) == roots[case] / "arm"
    assert find_case("liver") == roots[1] / "liver"
    assert find_case("arm", [roots[1]]) == roots[1] / "arm"
    monkeypatch.delenv("US_SIM_CASES")
    monkeypatch.setenv("XDG_DATA_HOME", "/home/me/data")
    assert list_case_roots() == [Path("/home/me/data/us_sim/cases")]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("livr", r"livr.* arm, liver; .*mean 'liver'"),
        ("./one", r"one: .*case\.yaml"),
        ("./bare", r"volume\.nrrd"),
    ],
)
def test_what_is_no_case_is_said(roots, name, message):
    shutil.copytree(roots[0] / "arm", "bare")
    Path("bare/volume.nrrd").unlink()
    with pytest.raises(CaseError, match=message):
        read_case(find_case(name))
