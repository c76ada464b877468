"""Cases by name, in several folders."""

import os
import shutil
from pathlib import Path

import pytest

from us_sim.errors import CaseError
from us_sim.volume.cases.case import case_roots, cases_in, find_case


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


def test_a_name_is_looked_up_in_each_root_in_order(roots):
    assert case_roots() == roots
    assert find_case("arm") == roots[0] / "arm"
    assert find_case("liver") == roots[1] / "liver"


def test_a_path_is_a_case_too_and_goes_first(roots, tmp_path):
    assert find_case("two/arm") == roots[1] / "arm"
    assert find_case(roots[1] / "arm") == roots[1] / "arm"
    assert find_case("arm", [tmp_path / "two"]) == roots[1] / "arm"


@pytest.mark.usefixtures("roots")
def test_an_unknown_name_is_told_those_that_are_known():
    with pytest.raises(CaseError, match=r"no case livr; cases are arm, liver in .*mean liver\?"):
        find_case("livr")
    with pytest.raises(CaseError, match="there is no case"):
        find_case("../one/nothing")
    with pytest.raises(CaseError, match="there is no case"):
        find_case("")


@pytest.mark.usefixtures("roots")
def test_what_is_there_but_no_case_is_said(tmp_path):
    (tmp_path / "plain").mkdir()
    (tmp_path / "file.nrrd").touch()
    with pytest.raises(CaseError, match=r"plain: is a folder without a case\.yaml"):
        find_case(tmp_path / "plain")
    with pytest.raises(CaseError, match=r"file\.nrrd: is a file"):
        find_case(tmp_path / "file.nrrd")


def test_without_the_variable_cases_are_in_the_users_data(monkeypatch):
    monkeypatch.delenv("US_SIM_CASES", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", "/home/me/data")
    assert case_roots() == [Path("/home/me/data/us_sim/cases")]


def test_a_listing_passes_by_what_is_no_case(roots):
    (roots[1] / "notes").mkdir()
    (roots[1] / ".hidden").mkdir()
    os.symlink("loop", roots[1] / "loop")
    os.symlink("..", roots[1] / "up")
    assert cases_in(roots[1]) == [roots[1] / "arm", roots[1] / "liver"]
    assert cases_in(roots[1] / "arm") == [roots[1] / "arm"]
    with pytest.raises(CaseError, match="cannot be read"):
        cases_in(roots[1] / "nowhere")
