"""Settings that make no sense are refused by name."""

import pytest

from us_sim.errors import TrackingError
from us_sim.tracking.filter.kalman import ConstantVelocityKalman
from us_sim.tracking.filter.one_euro import OneEuro
from us_sim.tracking.filter.pose_filter import Unfiltered, create_filter
from us_sim.tracking.filter.settings import GateSettings, KalmanSettings, OneEuroSettings


@pytest.mark.parametrize(
    ("settings", "values", "words"),
    [
        (OneEuroSettings, {"minimum_cutoff": 0.0}, "filter.minimum_cutoff: 0 Hz is outside"),
        (OneEuroSettings, {"minimum_cutoff": "2 mm"}, "its units are Hz, kHz"),
        (KalmanSettings, {"acceleration": float("nan")}, "filter.acceleration: nan is not finite"),
        (GateSettings, {"maximum_speed": -1.0}, "gate.maximum_speed: -1 m/s is outside"),
        (GateSettings, {"accept_after": 2.5}, "gate.accept_after: 2.5 is not a whole number"),
        (GateSettings, {"confidence": 1.0}, "gate.confidence: 1 is outside"),
    ],
)
def test_what_makes_no_sense_is_refused_by_name(settings, values, words):
    with pytest.raises(TrackingError, match=words):
        settings(**values)


def test_units_are_understood():
    assert GateSettings(maximum_speed="500 mm/s").maximum_speed == 0.5
    assert GateSettings(maximum_angular_speed="180 deg/s").maximum_angular_speed == pytest.approx(
        3.14159265
    )
    assert GateSettings(accept_after=7.0).accept_after == 7


def test_each_method_is_its_filter():
    kinds = {"none": Unfiltered, "one_euro": OneEuro, "kalman": ConstantVelocityKalman}
    for method, kind in kinds.items():
        assert type(create_filter(method)) is kind
    with pytest.raises(TrackingError, match="filter 'median' is not one of none, one_euro"):
        create_filter("median")
