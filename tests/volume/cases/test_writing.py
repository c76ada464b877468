"""A case is made whole or not at all, and moduli alone change."""

import pytest

from us_sim.errors import CaseError, MaterialError
from us_sim.volume.cases.case import read_case
from us_sim.volume.cases.settings import CaseSettings
from us_sim.volume.cases.writing import (
    new_case,
    write_case_settings,
    write_constants_into,
)
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


def test_constants_change_and_nothing_else(make_case):
    folder = make_case()
    before = read_case(folder).settings
    constants = {"young_modulus": 9876.0, "lumen_pressure": 400.0}
    write_constants_into(folder, {"vein": {"young_modulus": 2345.0}, "tissue": constants})
    case = read_case(folder)
    assert case.settings.material_of("vein").young_modulus == 2345.0
    assert case.settings.material_of("tissue").young_modulus == 9876.0
    assert case.settings.material_of("tissue").lumen_pressure == 400.0
    for name in ("vein", "tissue"):
        was, now = before.material_of(name), case.settings.material_of(name)
        assert (now.poisson_ratio, now.density) == (was.poisson_ratio, was.density)
    assert case.settings.structures["vein"].label == before.structures["vein"].label


@pytest.mark.parametrize(
    ("constants", "error", "sentence"),
    [
        ({"vien": {"young_modulus": 1e3}}, CaseError, "vien"),
        ({"vein": {"young_modulus": -1.0}}, MaterialError, "young_modulus"),
    ],
)
def test_what_cannot_be_written_leaves_the_case_as_it_was(make_case, constants, error, sentence):
    folder = make_case()
    before = (folder / "case.yaml").read_bytes()
    with pytest.raises(error, match=sentence):
        write_constants_into(folder, constants)
    assert (folder / "case.yaml").read_bytes() == before
