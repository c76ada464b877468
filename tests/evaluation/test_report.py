"""The templates of reports."""

import pytest

from us_sim.evaluation.report import filled


def test_a_place_of_a_template_that_is_not_filled_is_an_error():
    assert filled("tissue", "locking", nodes="8,192", table="").startswith("## Locking\n\nError of")
    with pytest.raises(ValueError, match="table"):
        filled("tissue", "locking", nodes="8,192")
    with pytest.raises(ValueError, match="more"):
        filled("tissue", "locking", nodes="8,192", table="", more="")
