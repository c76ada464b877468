"""An arm with a thrombus, and one without, examined by images alone."""

import pytest
from blind_sonographer import examine_arm

from us_sim.volume.phantom.phantom import draw_thrombus

WITH, WITHOUT = 1, 4  # seeds


@pytest.mark.slow
@pytest.mark.parametrize("seed", [WITH, WITHOUT])
def test_who_looks_at_images_finds_what_there_is(seed):
    begin, end = draw_thrombus(seed)
    assert (end > begin) == (seed == WITH)
    is_right, answers, _ = examine_arm(seed)
    assert is_right
    assert ("not compressible" in answers) == (seed == WITH)
