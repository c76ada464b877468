"""Landmarks in files, and what cannot be used."""

import numpy as np
import pytest

from us_sim.errors import StiffnessError
from us_sim.tissue.identification.press_record import ChosenPoses, without_wrench
from us_sim.tissue.identification.stiffness import read_landmarks

GOOD = "name,time,x,y,z\nvein,,0,0,10 mm\nvein,0.5,0,0,12 mm\n"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name,x,y,z\n", "has no column time"),
        ("name,time,x,y,z\nvein,,0,0,1 kg\n", "line 2: .*1 kg"),
        ("name,time,x,y,z\nvein,1,0,0,0.01\n", "where it is at rest"),
        ("name,time,x,y,z\nvein,,0,0,0.01\n", "nothing was seen"),
        ("name,time,x,y,z\nvein,,0,0,0.01\nvein,,0,0,0.02\n", "at rest twice"),
        ("name,time,x,y,z\nvein,,0,0\n", "line 2"),
    ],
)
def test_what_is_no_list_of_landmarks_is_refused(tmp_path, text, sentence):
    file = tmp_path / "seen.csv"
    file.write_text(text)
    with pytest.raises(StiffnessError, match=sentence):
        read_landmarks(file)


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(StiffnessError, match="cannot be read"):
        read_landmarks(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (GOOD.replace("0.5", "9"), "no pose with a wrench is within 10 ms"),
        (GOOD.replace("10 mm", "-40 mm"), "40.0 mm outside the tissue's mesh"),
        (GOOD.replace("0.5", "0.0"), "no landmark was seen while the probe pressed"),
    ],
)
def test_landmarks_must_fit_the_press_and_the_tissue(tmp_path, press, text, sentence):
    file = tmp_path / "seen.csv"
    file.write_text(text)
    path = press.path
    record = without_wrench((path.stamps, path.positions, path.orientations))
    apart = -path.positions[:, 2] + 0.02
    apart[0] = 0.01
    apart[10] = -0.005
    chosen = ChosenPoses(np.array([10]), np.array([0]), apart)
    with pytest.raises(StiffnessError, match=sentence):
        read_landmarks(file).at(record, chosen, press.tissue.model.mesh, 0.01)
