"""What was done to a case, as its file says it."""

import pytest

from us_sim.errors import CaseError
from us_sim.volume.cases.provenance import read_steps


@pytest.mark.parametrize(
    ("step", "why"),
    [
        ("what: a\n  us_sim: '1'\n  counts:", "counts: must be keys with values"),
        ("what: a\n  us_sim: '1'\n  settings: 4", "settings: must be keys with values"),
        ("what: a\n  us_sim: '1'\n  sources: 4", "not iterable"),
        ("3", "a step must be keys with values"),
    ],
)
def test_a_step_of_another_shape_is_refused_in_a_sentence(tmp_path, step, why):
    (tmp_path / "provenance.yaml").write_text(f"steps:\n- {step}\n")
    with pytest.raises(CaseError, match=f"is no provenance that us_sim wrote: .*{why}"):
        read_steps(tmp_path)
