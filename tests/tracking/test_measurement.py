"""What a covariance must be."""

import numpy as np
import pytest

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.tracking.measurement import Measurement


def test_a_covariance_that_is_symmetric_but_for_rounding_is_taken():
    covariance = np.diag([1e-8, 1e-8, 1e-8, 1e-5, 1e-5, 1e-5])
    covariance[0, 5], covariance[5, 0] = 1e-22, -1e-22
    seen = Measurement(0, Pose(), covariance)
    assert seen.position_deviation == pytest.approx(np.sqrt(3e-8))
    assert not seen.covariance.flags.writeable


@pytest.mark.parametrize(
    "covariance",
    [np.eye(3), np.full((6, 6), np.nan), np.inf * np.ones((6, 6)), np.triu(np.ones((6, 6)))],
)
def test_what_is_no_covariance_is_refused(covariance):
    with pytest.raises(TrackingError, match=r"finite symmetric \(6, 6\) matrix"):
        Measurement(0, Pose(), covariance)
