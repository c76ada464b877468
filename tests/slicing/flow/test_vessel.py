"""A vessel's flow against the closed forms of its circuit, and its pulse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.errors import SceneError
from us_sim.slicing.flow.vessel import VISCOSITY, Circulation, Waveform
from us_sim.slicing.settings import FlowSettings

AREA, SPACING, STATIONS = 1.5e-5, 2e-3, 30
REST = np.full(STATIONS, AREA)
ARTERY = FlowSettings("arterial", (0, 1, 0), 0.8, 0.1, closed_at=0.0)
VEIN = FlowSettings("venous", (0, 1, 0), 0.2, 0.08, filling_time=5.0)


def steady(settings, areas):
    """The flow after a long time, over that at rest."""
    circulation = Circulation(settings, REST, SPACING)
    circulation.compute_flow(0.0, areas)
    return circulation.compute_flow(1e4, areas) / circulation.at_rest


def resistance(areas):
    return float((8 * np.pi * VISCOSITY * SPACING / areas**2).sum())


@given(open_=st.floats(0.01, 1.0), count=st.integers(1, STATIONS))
def test_a_narrowing_of_an_artery_falls_as_poiseuille_says(open_, count):
    """Driving pressure over the resistances in series, of the vessel and of what comes after it."""
    areas = REST.copy()
    areas[:count] *= open_
    whole = ARTERY.pressure_at_rest / (ARTERY.mean_velocity * AREA)
    narrowed = whole - resistance(REST) + resistance(areas)
    assert steady(ARTERY, areas) == pytest.approx(whole / narrowed)


@pytest.mark.parametrize("settings", [ARTERY, VEIN])
def test_a_vessel_closed_at_one_place_has_no_flow(settings):
    areas = REST.copy()
    areas[7] *= 0.9 * settings.closed_at
    assert steady(settings, areas) == 0.0


def test_a_closed_vein_fills_up_and_surges_when_it_opens():
    circulation = Circulation(VEIN, REST, SPACING)
    closed = 0.2 * REST
    circulation.compute_flow(0.0, REST)
    for step in range(1, 101):  # 4 s, in which the pressure goes towards that of the bed
        assert circulation.compute_flow(0.04 * step, closed) == 0.0
    bed, rest = VEIN.bed_pressure, VEIN.pressure_at_rest
    filled = bed - (bed - rest) * np.exp(-4.0 / VEIN.filling_time)
    assert circulation.pressure == pytest.approx(filled)
    surge = circulation.compute_flow(4.0 + 1e-9, REST)
    assert surge / circulation.at_rest == pytest.approx(filled / rest, rel=1e-6)
    # Open, it empties faster, by the flow that the bed's resistance lets follow.
    later = circulation.compute_flow(5.0, REST)
    left = np.exp(-1.0 * (bed / rest) / VEIN.filling_time)
    excess = (surge / circulation.at_rest - 1.0) * left
    assert later / circulation.at_rest == pytest.approx(1.0 + excess, rel=1e-6)


@given(st.lists(st.floats(1e-3, 2.0), min_size=1, max_size=6))
def test_frames_in_between_change_nothing(steps):
    """The equation is solved exactly from frame to frame."""
    areas = 0.6 * REST
    often, once = (Circulation(VEIN, REST, SPACING) for _ in range(2))
    for circulation in (often, once):
        circulation.compute_flow(0.0, 0.1 * REST)
        circulation.compute_flow(3.0, 0.1 * REST)
    for time in 3.0 + np.cumsum(steps):
        flow = often.compute_flow(time, areas)
    assert flow == pytest.approx(once.compute_flow(3.0 + np.sum(steps), areas), rel=1e-9)


def test_where_time_goes_back_it_is_at_rest_again():
    circulation = Circulation(VEIN, REST, SPACING)
    circulation.compute_flow(0.0, 0.1 * REST)
    circulation.compute_flow(30.0, 0.1 * REST)
    assert circulation.compute_flow(1.0, REST) == pytest.approx(circulation.at_rest)


MEANS = st.floats(0.01, 0.3)


@given(mean=MEANS, over=st.floats(2.0, 12.0), rate=st.floats(0.5, 3.0))
def test_an_artery_has_its_mean_over_a_beat_and_its_peak_in_it(mean, over, rate):
    pulse = Waveform(FlowSettings("arterial", (1, 0, 0), over * mean, mean, heart_rate=rate))
    beat = pulse((np.arange(4096) + 7) / (4096 * rate))
    assert beat.mean() == pytest.approx(1.0, abs=1e-6)
    assert beat.max() == pytest.approx(0.5 * over, rel=1e-4)  # on the axis twice the mean


@given(mean=MEANS, over=st.floats(2.0, 6.0))
def test_a_vein_swings_with_breathing_and_a_little_with_the_heart(mean, over):
    settings = FlowSettings(
        "venous", (1, 0, 0), over * mean, mean, heart_rate=1.25, respiration_rate=0.25
    )
    time = np.arange(0.0, 4.0, 1e-3)  # a breath, five beats
    flow = Waveform(settings)(time)
    assert flow.mean() == pytest.approx(1.0, abs=1e-9)
    assert flow.max() == pytest.approx(0.5 * over)
    swings = np.abs(np.fft.rfft(flow))[[1, 5]]
    assert swings[0] == pytest.approx(3 * swings[1], abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"peak_velocity": 0.1}, "flow.peak_velocity: 0.1 m/s"),
        ({"direction": (0, 0, 0)}, "flow.direction: has no length"),
        ({"kind": "venous", "pressure": 5e3}, "flow.bed_pressure: 3300 Pa"),
        ({"bed_pressure": 9e3}, "flow.bed_pressure: .* venous"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, sentence):
    right = {"kind": "arterial", "direction": (0, 1, 0), "peak_velocity": 0.8}
    with pytest.raises(SceneError, match=sentence):
        FlowSettings(**{**right, "mean_velocity": 0.09, **changes})
