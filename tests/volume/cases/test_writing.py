"""A case is made whole or not at all."""

import pytest

from us_sim.errors import CaseError
from us_sim.volume.cases.settings import CaseSettings
from us_sim.volume.cases.writing import new_case, write_case_settings
from us_sim.volume.files.writing import write_volume


@pytest.mark.parametrize("interruption", [RuntimeError, KeyboardInterrupt, None])
def test_nothing_is_left_of_a_case_that_was_broken_off_or_is_none(tmp_path, block, interruption):
    def broken_off():
        with new_case(tmp_path / "arm") as folder:
            write_volume(folder / "volume.nrrd", block)
            if interruption:
                write_case_settings(folder, CaseSettings("arm"))
                raise interruption("halfway")

    with pytest.raises(interruption or CaseError):
        broken_off()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", [".hidden", "a:b", "block"])
def test_a_case_has_a_name_that_folders_can_have_and_is_not_written_over(make_case, name):
    folder = make_case()
    before = (folder / "case.yaml").read_bytes()
    with pytest.raises(CaseError), new_case(folder.parent / name):
        pass
    assert (folder / "case.yaml").read_bytes() == before
