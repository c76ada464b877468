"""A pulse has the peak and the mean that are set, whatever they are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.errors import SceneError
from us_sim.slicing.flow.settings import FlowSettings
from us_sim.slicing.flow.waveform import Waveform

MEANS = st.floats(0.01, 0.3)


@given(mean=MEANS, over=st.floats(2.0, 12.0), rate=st.floats(0.5, 3.0))
def test_an_artery_has_its_mean_over_a_beat_and_its_peak_in_it(mean, over, rate):
    pulse = Waveform(FlowSettings("arterial", (1, 0, 0), over * mean, mean, heart_rate=rate))
    beat = pulse((np.arange(4096) + 7) / (4096 * rate))
    assert beat.mean() == pytest.approx(1.0, abs=1e-6)
    assert beat.max() == pytest.approx(0.5 * over, rel=1e-4)  # on the axis twice the mean


def test_the_pulse_at_rest_is_triphasic():
    pulse = Waveform(FlowSettings("arterial", (1, 0, 0), 0.8, 0.09, heart_rate=1.0))
    beat = pulse(np.arange(1000) / 1000)
    turns = np.flatnonzero(np.diff(np.sign(beat)))
    systole, reversal, diastole = np.split(beat, turns + 1)[:3]
    assert systole.max() == beat.max()
    assert reversal.max() < 0.0 < diastole.min()
    assert len(turns) == 2


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
        ({"peak_velocity": 0.1}, "flow.peak_velocity: 0.1 m/s is less than twice mean_velocity"),
        ({"direction": (0, 0, 0)}, "flow.direction: has no length"),
        ({"kind": "venous", "pressure": 5e3}, "flow.bed_pressure: 3300 Pa is not above the 5000"),
        ({"bed_pressure": 9e3}, "flow.bed_pressure: is for kind venous only, not arterial"),
        ({"kind": "lymph"}, "flow.kind: 'lymph' is not one of arterial, venous"),
        ({"heart_rate": 66}, "flow.heart_rate: 66 Hz is outside .*; did you mean '66 /min'"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, sentence):
    right = {"kind": "arterial", "direction": (0, 1, 0), "peak_velocity": 0.8}
    with pytest.raises(SceneError, match=sentence):
        FlowSettings(**{**right, "mean_velocity": 0.09, **changes})
