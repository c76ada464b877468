"""Demands on a covariance.

The state by a table: what comes when, and what it is then.
"""

import numpy as np
import pytest

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.tracking.filters import create_filter
from us_sim.tracking.measurement import Measurement, TrackingState
from us_sim.tracking.probe_tracking import ProbeTracking


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
    with pytest.raises(TrackingError, match="finite symmetric"):
        Measurement(0, Pose(), covariance)


WAITING, TRACKED = TrackingState.WAITING, TrackingState.TRACKED
COASTING, LOST = TrackingState.COASTING, TrackingState.LOST

# ms, what happens (a pose is believed, the tracking is reset, or nothing), and the state then
TABLE = [
    (0, "", WAITING),
    (10_000, "", WAITING),
    (10_000, "pose", TRACKED),
    (10_299, "", TRACKED),
    (10_300, "", COASTING),
    (10_999, "", COASTING),
    (11_000, "", LOST),
    (99_000, "", LOST),
    (99_000, "pose", TRACKED),
    (99_200, "pose", TRACKED),
    (99_450, "", TRACKED),
    (99_600, "", COASTING),
    (99_600, "pose", TRACKED),
    (99_900, "", COASTING),
    (50_000, "", TRACKED),  # the clock is set back: the age of the pose counts from now on
    (50_300, "", COASTING),
    (51_000, "", LOST),
    (51_000, "reset", WAITING),
    (51_001, "", WAITING),
    (51_002, "pose", TRACKED),
]


def test_states_follow_the_table():
    tracking = ProbeTracking(Pose(), Pose(), create_filter("none"), coast_for=0.3, lost_after=1.0)
    for number, (ms, event, expected) in enumerate(TABLE):
        now = ms * 1_000_000
        if event == "pose":
            tracking.process_measurement(Measurement(number, Pose()), now)
        elif event == "reset":
            tracking.reset()
        assert tracking.find_state(now) is expected, f"at {ms} ms"
