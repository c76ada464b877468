"""The spectrum at a gate against the velocities that are in it."""

import dataclasses

import numpy as np
import pytest
from tubes import ARTERY, SIDES, VEIN, block, tube_vessel, tube_volume

from us_sim.errors import ProbeError
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.doppler import Spectrum
from us_sim.slicing.probe.probe import LinearProbe, SectorProbe
from us_sim.slicing.settings import SpectrumSettings

PROBE = LinearProbe(aperture=0.018, depth=0.024, columns=90, rows=120)
TILT = np.radians(30)
POSE = Pose(
    [0.0, 0.5 * SIDES[2] * np.tan(TILT), 0.0], [np.sin(TILT / 2), 0.0, 0.0, np.cos(TILT / 2)]
)
MIDDLE = 0.5 * SIDES[2] / np.cos(TILT)
GATE = SpectrumSettings(depth=MIDDLE, size=1e-3, nyquist_velocity=0.6, wall_filter=0.0)
ROWS = 256


@pytest.fixture(scope="module")
def scanner():
    made = BMode(tube_volume(), PROBE)
    made.carry(block().nodes, block().tetrahedra)
    return made


@pytest.fixture(scope="module")
def artery():
    return tube_vessel(ARTERY)


def velocities(settings):
    """m/s along the beam that the rows stand for, from the top."""
    nyquist = settings.nyquist_velocity
    low = nyquist * (settings.baseline - 1.0)
    return low + (ROWS - 0.5 - np.arange(ROWS)) * (2 * nyquist / ROWS)


def middles(columns, settings):
    """The mean velocity of each column, by what is bright in it."""
    bright = np.where(columns > 100, columns.astype(float), 0.0)
    return velocities(settings) @ bright / bright.sum(axis=0)


def test_its_middle_follows_the_pulse(scanner, artery):
    """The axis at the gate's middle is a little faster than what else is in the gate."""
    blood = Blood([artery])
    frame = scanner.frame(POSE, block().nodes, time=0.0)
    moments = np.arange(100) / 110
    found = middles(Spectrum(PROBE, GATE).columns(blood, frame, moments), GATE)
    blood.at(frame)
    sign = -np.sign(POSE.rotation[1, 2])
    axis = 2 * sign * ARTERY.mean_velocity * artery.pulse(moments) * np.sin(TILT)
    assert np.corrcoef(found, axis)[0, 1] > 0.995
    fast = np.abs(axis) > 0.1
    assert (found[fast] / axis[fast]).mean() == pytest.approx(0.98, abs=0.04)
    assert np.abs(axis).max() == pytest.approx(0.4, rel=0.02)


def test_what_is_beyond_the_nyquist_velocity_comes_in_at_the_other_end(scanner, artery):
    settings = dataclasses.replace(GATE, nyquist_velocity=0.3)
    blood, frame = Blood([artery]), scanner.frame(POSE, block().nodes, time=0.0)
    systole = np.full(8, 0.13 / 1.1)
    true = middles(Spectrum(PROBE, GATE).columns(blood, frame, systole), GATE).mean()
    seen = middles(Spectrum(PROBE, settings).columns(blood, frame, systole), settings).mean()
    assert abs(true) > 0.3
    assert seen == pytest.approx(true - np.sign(true) * 0.6, abs=0.03)
    moved = dataclasses.replace(settings, baseline=0.5 * np.sign(true))
    again = middles(Spectrum(PROBE, moved).columns(blood, frame, systole), moved).mean()
    assert again == pytest.approx(true, abs=0.03)


def test_no_column_depends_on_when_frames_come(scanner, artery):
    """Two frames or forty between the same times: the same picture, byte for byte."""
    pictures = []
    for times in (np.linspace(2.0, 3.0, 3), np.linspace(2.0, 3.0, 41)):
        blood, spectrum = Blood([artery]), Spectrum(PROBE, GATE)
        for time in times:
            picture = spectrum.show(blood, scanner.frame(POSE, block().nodes, time=time))
        pictures.append(picture)
    assert np.array_equal(*pictures)
    assert pictures[0].any()


def test_the_wall_filter_and_an_empty_gate_are_dark(scanner, artery):
    blood, frame = Blood([artery]), scanner.frame(POSE, block().nodes, time=0.0)
    moments = np.arange(20) / 22
    filtered = dataclasses.replace(GATE, wall_filter=0.1)
    slow = np.abs(velocities(GATE)) < 0.015
    assert Spectrum(PROBE, GATE).columns(blood, frame, moments)[slow].max() > 150
    assert Spectrum(PROBE, filtered).columns(blood, frame, moments)[slow].max() < 60
    beside = dataclasses.replace(GATE, lateral=0.4)
    assert Spectrum(PROBE, beside).columns(blood, frame, moments).max() < 60


def test_a_vein_under_a_full_press_shows_none(scanner):
    vein = tube_vessel(VEIN)
    pressed = block().nodes.copy()
    pressed[:, 2] = 0.5 * SIDES[2] + 0.2 * (pressed[:, 2] - 0.5 * SIDES[2])
    frame = scanner.frame(POSE, pressed, time=4.0)
    columns = Spectrum(PROBE, GATE).columns(Blood([vein]), frame, np.arange(10) / 5)
    lit = columns.max(axis=1) > 100
    assert np.abs(velocities(GATE)[lit]).max(initial=0.0) < 0.04  # blood that stands


@pytest.mark.parametrize(
    ("probe", "settings", "sentence"),
    [
        (PROBE, {"depth": 0.03}, "spectrum.depth: the gate at 30 mm lies outside the image, which"),
        (PROBE, {"lateral": 0.5, "steering": 0.4}, "spectrum.steering: the gate lies beside the"),
        (
            SectorProbe(aperture=0.02, opening_angle=1.0, depth=0.05, columns=80, rows=80),
            {"steering": 0.1},
            "spectrum.steering: is for linear probes only",
        ),
    ],
)
def test_a_gate_outside_the_image_is_refused(probe, settings, sentence):
    with pytest.raises(ProbeError, match=sentence):
        Spectrum(probe, SpectrumSettings(**settings))
