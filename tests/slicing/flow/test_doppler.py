"""Colour Doppler and spectra against velocities that are known."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path
from tubes import ARTERY, SIDES, block, tube_vessel, tube_volume

from us_sim.errors import ProbeError
from us_sim.geometry.pose import Pose
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.flow.blood import Blood, FlowAbsence
from us_sim.slicing.flow.doppler import ColourDoppler, Spectrum
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, SectorProbe
from us_sim.slicing.settings import ColourSettings, Imaging, SpectrumSettings

PROBE = LinearProbe(aperture=0.018, depth=0.02, columns=90, rows=100)
TILT = np.radians(30)
WIDE = ColourSettings(width=1.0, height=0.02, resolution=0.0, persistence=0.0, wall_filter=0.0)
POSE = Pose(
    [0.0, 0.5 * SIDES[2] * np.tan(TILT), 0.0], [np.sin(TILT / 2), 0.0, 0.0, np.cos(TILT / 2)]
)
SYSTOLE = 0.13 / 1.1


@pytest.fixture(scope="module")
def scanner():
    made = BMode(tube_volume(), PROBE)
    made.attach_mesh(block().nodes, block().tetrahedra)
    return made


@pytest.fixture(scope="module")
def blood():
    return Blood([tube_vessel(ARTERY)])


def frame_at(scanner, time):
    return scanner.make_frame(POSE, block().nodes, time=time)


def wrapped(velocity, nyquist):
    """The aliased velocity, between -nyquist and nyquist."""
    return (velocity + nyquist) % (2 * nyquist) - nyquist


def apart(estimate, truth, nyquist):
    """How far apart two velocities are on the circle that aliasing makes of them."""
    return np.abs(wrapped(estimate - truth, nyquist))


@pytest.mark.parametrize("nyquist", [0.1, 0.25, 0.6])
def test_velocities_turn_over_at_the_nyquist_velocity(scanner, blood, nyquist):
    settings = dataclasses.replace(WIDE, nyquist_velocity=nyquist, pulses=64)
    doppler = ColourDoppler(PROBE, settings)
    frame = frame_at(scanner, SYSTOLE)
    truth, estimate = (
        doppler.compute_true_velocity(blood, frame),
        doppler.estimate_velocity(blood, frame),
    )
    shown = ~np.isnan(estimate) & ~np.isnan(truth)
    assert np.count_nonzero(shown) > 0.95 * np.count_nonzero(~np.isnan(truth))
    assert np.nanmax(np.abs(truth)) == pytest.approx(0.4, rel=0.03)  # 0.8 m/s at 60 degrees
    error = apart(estimate, truth, nyquist)[shown]
    assert np.sqrt(np.mean(error**2)) < 0.04 * nyquist
    assert np.nanmax(np.abs(estimate)) <= nyquist * (1 + 1e-6)
    assert (np.abs(estimate[shown] - truth[shown]) > nyquist).any() == (nyquist < 0.4)


def test_noise_falls_with_the_root_of_the_number_of_pulses(scanner, blood):
    spread = {}
    for pulses in (4, 16, 64):
        doppler = ColourDoppler(
            PROBE, dataclasses.replace(WIDE, nyquist_velocity=1.0, pulses=pulses)
        )
        errors = []
        for beat in range(20):
            frame = frame_at(scanner, SYSTOLE + beat / 1.1)
            errors.append(
                doppler.estimate_velocity(blood, frame)
                - doppler.compute_true_velocity(blood, frame)
            )
        spread[pulses] = np.nanstd(errors)
    assert spread[4] / spread[16] == pytest.approx(2.0, rel=0.1)
    assert spread[16] / spread[64] == pytest.approx(2.0, rel=0.1)


def test_the_wall_filter_takes_what_is_slow(scanner, blood):
    frame = frame_at(scanner, SYSTOLE)
    truth = ColourDoppler(PROBE, WIDE).compute_true_velocity(blood, frame)
    settings = dataclasses.replace(WIDE, nyquist_velocity=1.0, wall_filter=0.15, pulses=64)
    estimate = ColourDoppler(PROBE, settings).estimate_velocity(blood, frame)
    inside = ~np.isnan(truth)
    assert np.isnan(estimate[inside & (np.abs(truth) < 0.07)]).all()
    assert not np.isnan(estimate[inside & (np.abs(truth) > 0.2)]).any()


@pytest.mark.parametrize(
    ("why", "fan", "given"),
    [
        (FlowAbsence.NOTHING, TILT, {}),
        (FlowAbsence.NO_CONTACT, TILT, {}),
        (FlowAbsence.NO_VESSEL, TILT, {"width": 0.1, "lateral": 0.4}),
        (FlowAbsence.NO_FLOW, TILT, {}),
        (FlowAbsence.ACROSS_FLOW, np.radians(1), {"wall_filter": 0.05}),
        (FlowAbsence.TOO_SLOW, np.radians(8), {"wall_filter": 0.2, "nyquist_velocity": 0.6}),
    ],
)
def test_why_no_colour_is_shown_is_told(scanner, why, fan, given):
    pose = Pose([0.0, 0.0, 0.0], [np.sin(fan / 2), 0.0, 0.0, np.cos(fan / 2)])
    frame = scanner.make_frame(pose, block().nodes, time=SYSTOLE)
    blood = Blood([tube_vessel(ARTERY)]).advance_to_frame(frame)
    air = why is FlowAbsence.NO_CONTACT
    frame.contact = np.full(PROBE.lines, 0.0 if air else 1.0), np.zeros(PROBE.lines)
    if why is FlowAbsence.NO_FLOW:
        blood.vessels[0].axis_velocity[:] = 0.0
    doppler = ColourDoppler(PROBE, dataclasses.replace(WIDE, **given))
    shown = doppler.estimate_velocity(blood, frame)
    assert np.isfinite(shown).any() == (why is FlowAbsence.NOTHING)
    assert doppler.explain_absence(blood, frame, shown) is why


def test_persistence_keeps_what_was_and_forgets_it_after_a_pause(scanner):
    settings = dataclasses.replace(WIDE, persistence=0.9, pulses=64)
    doppler, blood = ColourDoppler(PROBE, settings), Blood([tube_vessel(ARTERY)])
    first = doppler.estimate_velocity(blood, frame_at(scanner, SYSTOLE))
    slow = SYSTOLE + 0.3
    kept = doppler.estimate_velocity(blood, frame_at(scanner, slow))
    fresh = ColourDoppler(PROBE, settings).estimate_velocity(blood, frame_at(scanner, slow))
    shown = ~np.isnan(first) & ~np.isnan(kept) & ~np.isnan(fresh)
    nearer = np.abs(kept - first)[shown] < np.abs(kept - fresh)[shown]
    assert nearer.mean() > 0.9
    late = doppler.estimate_velocity(blood, frame_at(scanner, slow + 10 / 1.1))
    again = ColourDoppler(PROBE, settings).estimate_velocity(
        blood, frame_at(scanner, slow + 10 / 1.1)
    )
    assert np.array_equal(late, again, equal_nan=True)


@settings(deadline=None, max_examples=30)
@given(
    lateral=st.floats(-0.5, 0.5),
    width=st.floats(0.2, 1.0),
    depth=st.floats(2e-3, 18e-3),
    height=st.floats(2e-3, 30e-3),
    steering=st.floats(-0.5, 0.5),
)
def test_colour_is_shown_within_its_box_only(lateral, width, depth, height, steering):
    asked = ColourSettings(
        lateral,
        depth,
        steering=steering,
        width=width,
        height=height,
        gain=30.0,
        resolution=0.0,
    )
    doppler = ColourDoppler(PROBE, asked)
    scanner, blood = BMode(SMALL.volume, PROBE), SMALL.blood
    shown = ~np.isnan(doppler.estimate_velocity(blood, scanner.make_frame(POSE, None, time=1.0)))
    matrix = PROBE.image_to_probe
    x = matrix[0, 3] + matrix[0, 0] * np.arange(PROBE.columns)
    z = matrix[2, 3] + matrix[2, 1] * np.arange(PROBE.rows)[:, None]
    across = (x - (z - depth) * np.tan(steering)) / PROBE.aperture - lateral
    slack = 1e-6
    inside = (np.abs(across) < 0.5 * width + slack) & (np.abs(z - depth) < 0.5 * height + slack)
    assert not (shown & ~inside).any()
    column, row = np.meshgrid(np.arange(PROBE.columns), np.arange(PROBE.rows))
    grown = Path(doppler.outline).contains_points(
        np.column_stack([column[shown], row[shown]]), radius=0.1
    ) | Path(doppler.outline).contains_points(
        np.column_stack([column[shown], row[shown]]), radius=-0.1
    )
    assert grown.all()


class SMALL:
    """A volume and its blood, made once for all examples."""

    volume = tube_volume(voxel=1e-3)
    blood = Blood([tube_vessel(ARTERY, volume)])


def test_steered_beams_see_a_vessel_in_the_image_by_the_angle(scanner):
    """Along the tube upright beams see nothing; steered ones the sine of the angle."""
    along = Pose([0.0, 0.0, 0.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    frame = scanner.make_frame(along, block().nodes, time=SYSTOLE)
    blood = Blood([tube_vessel(ARTERY)])
    for steering in (0.0, 0.2, 0.4):
        doppler = ColourDoppler(PROBE, dataclasses.replace(WIDE, steering=steering))
        fastest = np.nanmax(np.abs(doppler.compute_true_velocity(blood, frame)))
        assert fastest == pytest.approx(0.8 * np.sin(steering), rel=0.03, abs=0.02)


@pytest.mark.parametrize(
    ("probe", "settings", "key"),
    [
        (PROBE, {"depth": 0.025}, "colour.depth: .* 25 mm"),
        (
            ConvexProbe(radius=0.03, opening_angle=1.0, depth=0.05, columns=80, rows=80),
            {"steering": 0.1},
            "colour.steering",
        ),
        (
            LinearProbe(aperture=0.02, depth=0.02, columns=4, rows=4),
            {"width": 0.02, "lateral": 0.1, "height": 1e-3},
            "colour.width",
        ),
    ],
)
def test_a_box_outside_the_image_is_refused(probe, settings, key):
    with pytest.raises(ProbeError, match=key):
        ColourDoppler(probe, ColourSettings(**settings))


def test_beams_whose_face_is_in_the_air_show_nothing():
    """With the face along the vessel and one end lifted, lines there are not coupled."""
    volume = tube_volume()
    blood = Blood([tube_vessel(ARTERY, volume)])
    turn = np.radians(30) / 2  # about y, so that one end of the face is lifted
    lifted = Pose([0.0, 0.0, -1e-3], [0.0, np.sin(turn), 0.0, np.cos(turn)])
    along = Pose([0.0] * 3, [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    frames = [
        BMode(volume, PROBE, Imaging(contact=contact)).make_frame(
            along @ lifted, None, time=SYSTOLE
        )
        for contact in (True, False)
    ]
    coupling, _ = frames[0].contact
    assert coupling.min() == 0.0
    assert frames[1].contact is None
    settings_ = dataclasses.replace(WIDE, nyquist_velocity=1.0)
    coupled, free = (
        ~np.isnan(ColourDoppler(PROBE, settings_).estimate_velocity(blood, frame))
        for frame in frames
    )
    dead = coupling[np.linspace(0, PROBE.lines - 1, PROBE.columns).round().astype(int)] < 0.1
    assert free[:, dead].any()
    assert not coupled[:, dead].any()


GATE_PROBE = LinearProbe(aperture=0.018, depth=0.024, columns=90, rows=120)
MIDDLE = 0.5 * SIDES[2] / np.cos(TILT)
GATE = SpectrumSettings(depth=MIDDLE, size=1e-3, nyquist_velocity=0.6, wall_filter=0.0)
ROWS = 256


@pytest.fixture(scope="module")
def gate_scanner():
    made = BMode(tube_volume(), GATE_PROBE)
    made.attach_mesh(block().nodes, block().tetrahedra)
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


def test_its_middle_follows_the_pulse(gate_scanner, artery):
    """The axis at the gate's middle is a little faster than what else is in the gate."""
    blood = Blood([artery])
    frame = gate_scanner.make_frame(POSE, block().nodes, time=0.0)
    moments = np.arange(100) / 110
    columns, seen = Spectrum(GATE_PROBE, GATE).compute_columns(blood, frame, moments)
    found = middles(columns, GATE)
    blood.advance_to_frame(frame)
    sign = -np.sign(POSE.rotation[1, 2])
    axis = 2 * sign * ARTERY.mean_velocity * artery.evaluate_pulse(moments) * np.sin(TILT)
    assert seen.all()
    assert np.corrcoef(found, axis)[0, 1] > 0.995
    fast = np.abs(axis) > 0.1
    assert (found[fast] / axis[fast]).mean() == pytest.approx(0.98, abs=0.04)
    assert np.abs(axis).max() == pytest.approx(0.4, rel=0.02)


def test_no_column_depends_on_when_frames_come(gate_scanner, artery):
    """Two frames or forty between the same times: the same picture, byte for byte."""
    pictures = []
    for times in (np.linspace(2.0, 3.0, 3), np.linspace(2.0, 3.0, 41)):
        blood, spectrum = Blood([artery]), Spectrum(GATE_PROBE, GATE)
        for time in times:
            picture = spectrum.draw_sweep(
                blood, gate_scanner.make_frame(POSE, block().nodes, time=time)
            )
        pictures.append(picture)
    assert np.array_equal(*pictures)
    assert pictures[0].any()


@pytest.mark.parametrize(
    ("probe", "settings", "key"),
    [
        (
            GATE_PROBE,
            {"depth": 0.03},
            "spectrum.depth: .* 30 mm",
        ),
        (
            GATE_PROBE,
            {"lateral": 0.5, "steering": 0.4},
            "spectrum.steering: .* beside",
        ),
        (
            SectorProbe(aperture=0.02, opening_angle=1.0, depth=0.05, columns=80, rows=80),
            {"steering": 0.1},
            "spectrum.steering: .* linear",
        ),
    ],
)
def test_a_gate_outside_the_image_is_refused(probe, settings, key):
    with pytest.raises(ProbeError, match=key):
        Spectrum(probe, SpectrumSettings(**settings))


def strip_of(frame, blood, **given):
    """A gate's spectrum after it was shown a second of a frame's blood, and whether one is drawn.

    The line at 0 cm/s is drawn always, with a grey of 90.
    """
    spectrum = Spectrum(GATE_PROBE, dataclasses.replace(GATE, sweep=1.0, **given))
    for frame.time in np.arange(1.0, 2.01, 0.05):
        picture = spectrum.draw_sweep(blood, frame)
    return spectrum, np.count_nonzero(picture[:ROWS, :500, 0] > 90) > 100


@pytest.mark.parametrize(
    ("why", "fan", "coupling", "given"),
    [
        (FlowAbsence.NOTHING, np.radians(4), 1.0, {}),  # nearly across, and drawn all the same
        (FlowAbsence.NOTHING, TILT, 0.2, {}),
        (FlowAbsence.NO_CONTACT, TILT, 0.0, {}),
        (FlowAbsence.NO_VESSEL, TILT, 1.0, {"lateral": 0.45}),
        (FlowAbsence.ACROSS_FLOW, 0.0, 1.0, {"wall_filter": 0.02}),
        (FlowAbsence.TOO_SLOW, np.radians(8), 1.0, {"wall_filter": 0.2}),
    ],
)
def test_why_there_is_no_spectrum_is_told_where_none_is_drawn(
    gate_scanner, why, fan, coupling, given
):
    middle = Pose([0.0, 0.5 * SIDES[2] * np.tan(fan), 0.0])
    pose = middle @ Pose([0.0] * 3, [np.sin(fan / 2), 0.0, 0.0, np.cos(fan / 2)])
    frame = gate_scanner.make_frame(pose, block().nodes, time=1.0)
    frame.contact = np.full(GATE_PROBE.lines, coupling), np.zeros(GATE_PROBE.lines)
    depth = 0.5 * SIDES[2] / np.cos(fan)
    slow = dataclasses.replace(ARTERY, peak_velocity=0.2, mean_velocity=0.05)
    blood = Blood([tube_vessel(slow if why is FlowAbsence.TOO_SLOW else ARTERY)])
    spectrum, is_drawn = strip_of(frame, blood, depth=depth, **given)
    assert is_drawn == (why is FlowAbsence.NOTHING)
    assert spectrum.explain_absence(blood, frame) is why


def test_there_is_a_spectrum_as_long_as_it_is_on_the_strip(gate_scanner, artery):
    frame = gate_scanner.make_frame(POSE, block().nodes, time=1.0)
    blood = Blood([artery])
    spectrum, _ = strip_of(frame, blood)
    frame.contact = np.zeros(GATE_PROBE.lines), np.zeros(GATE_PROBE.lines)
    for frame.time, why in ((2.5, FlowAbsence.NOTHING), (3.1, FlowAbsence.NO_CONTACT)):
        spectrum.draw_sweep(blood, frame)
        assert spectrum.explain_absence(blood, frame) is why
