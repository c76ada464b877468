"""Moduli in a case: only they change, and the case says how they were found."""

import pytest

from us_sim.errors import CaseError, MaterialError
from us_sim.volume.cases.case import read_case
from us_sim.volume.cases.provenance import Step
from us_sim.volume.cases.writing import write_moduli_into

STEP = Step("fitted stiffness to a press", {"confidence": 0.95}, {"poses": 48})


def test_moduli_change_and_nothing_else(make_case):
    folder = make_case()
    before = read_case(folder).settings
    write_moduli_into(folder, {"vein": 2345.0, "tissue": 9876.0}, STEP)
    case = read_case(folder)
    assert case.settings.material_of("vein").young_modulus == 2345.0
    assert case.settings.material_of("tissue").young_modulus == 9876.0
    for name in ("vein", "tissue"):
        was, now = before.material_of(name), case.settings.material_of(name)
        assert (now.poisson_ratio, now.density) == (was.poisson_ratio, was.density)
    assert case.settings.structures["vein"].label == before.structures["vein"].label
    assert case.steps[-1].what == STEP.what
    assert case.steps[-1].counts == {"poses": 48}


@pytest.mark.parametrize(
    ("moduli", "error", "sentence"),
    [({"vien": 1e3}, CaseError, "vien"), ({"vein": -1.0}, MaterialError, "young_modulus")],
)
def test_what_cannot_be_written_leaves_the_case_as_it_was(make_case, moduli, error, sentence):
    folder = make_case()
    before = (folder / "case.yaml").read_bytes()
    with pytest.raises(error, match=sentence):
        write_moduli_into(folder, moduli, STEP)
    assert (folder / "case.yaml").read_bytes() == before
    assert read_case(folder).steps == ()
